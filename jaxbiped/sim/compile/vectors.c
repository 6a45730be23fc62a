/* Blocks of W lanes as vectors, and the functions of them that C does not have. REAL and WORD are float and int, or
   double and long long. A truth is a word of ones or of zeros. */
#include <math.h>
#include <stddef.h>

#define EACH for (int i = 0; i < W; i++)
typedef REAL F __attribute__((vector_size(W * sizeof(REAL)), may_alias));
typedef WORD M __attribute__((vector_size(W * sizeof(WORD)), may_alias));
typedef unsigned WORD U __attribute__((vector_size(W * sizeof(WORD)), may_alias));
typedef REAL FU __attribute__((vector_size(W * sizeof(REAL)), aligned(sizeof(REAL)), may_alias));

#define VF(x) ((F){0} + (REAL)(x))
#define VM(x) ((M){0} + (WORD)(x))
#define SIGN VM((WORD)1 << (8 * sizeof(WORD) - 1))
#define TO_F(x) __builtin_convertvector(x, F)
#if defined(__cplusplus)
#define SELECT(p, no, yes) ((p) ? (yes) : (no))
#else
static inline F select_f(M p, F no, F yes) { return (F)(((M)yes & p) | ((M)no & ~p)); }
static inline M select_m(M p, M no, M yes) { return (yes & p) | (no & ~p); }
#define SELECT(p, no, yes) _Generic((no), F: select_f, M: select_m)(p, no, yes)
#endif

#define LANEWISE(name, function) static inline F name(F x) { F r; EACH r[i] = function(x[i]); return r; }
#define LANEWISE2(name, function) static inline F name(F x, F y) { F r; EACH r[i] = function(x[i], y[i]); return r; }
static inline F vabs(F x) { return (F)((M)x & ~SIGN); }
static inline F vmax(F x, F y) { return SELECT((x > y) | (x != x), y, x); }
static inline F vmin(F x, F y) { return SELECT((x < y) | (x != x), y, x); }
static inline M imax(M x, M y) { return SELECT(x > y, y, x); }
static inline M imin(M x, M y) { return SELECT(x < y, y, x); }
static inline F vsign(F x) { return SELECT(x > 0, SELECT(x < 0, x, VF(-1)), VF(1)); }
static inline M isign(M x) { return (x < 0) - (x > 0); }
static inline M iabs(M x) { return SELECT(x < 0, x, -x); }
static inline M is_finite(F x) { return vabs(x) < VF(INFINITY); }
static inline M to_int(F x) {
  const REAL top = sizeof(REAL) == 4 ? 2147483520.0 : 2147483647.0;
  x = SELECT(x != x, x, VF(0));
  return __builtin_convertvector(vmin(vmax(x, VF(-2147483648.0)), VF(top)), M);
}
static inline F take(const REAL *table, M row, int step) { F r; EACH r[i] = table[(long)row[i] * step]; return r; }

#if SINGLE
LANEWISE(vsqrt, __builtin_sqrtf) LANEWISE(vfloor, __builtin_floorf) LANEWISE(vceil, __builtin_ceilf)
LANEWISE(vround, __builtin_rintf) LANEWISE(vexp, expf) LANEWISE(vlog, logf) LANEWISE(vlog1p, log1pf)
LANEWISE(vtan, tanf)
LANEWISE(vtanh, tanhf) LANEWISE2(vpow, powf) LANEWISE2(vrem, fmodf)

/* Sine and cosine after S. Moshier's Cephes; to 2 ulp up to some thousands of turns. */
static inline F turned(F x, M more) {
  F q = (x * (REAL)0.63661977236758134 + (REAL)12582912.0) - (REAL)12582912.0;
  M quarter = __builtin_convertvector(SELECT(vabs(q) < (REAL)4194304.0, VF(0), q), M) + more;
  F r = x - q * (REAL)1.5703125;
  r = r - q * (REAL)4.837512969970703125e-4;
  r = r - q * (REAL)7.54978995489188216e-8;
  F z = r * r;
  F s = r + r * z * ((REAL)-1.6666654611e-1 + z * ((REAL)8.3321608736e-3 + z * (REAL)-1.9515295891e-4));
  F c = 1 - (REAL)0.5 * z
      + z * z * ((REAL)4.166664568298827e-2 + z * ((REAL)-1.388731625493765e-3 + z * (REAL)2.443315711809948e-5));
  F e = SELECT((quarter & 1) != 0, s, c);
  return SELECT((quarter & 2) != 0, e, -e);
}
static inline F vsin(F x) { return turned(x, VM(0)); }
static inline F vcos(F x) { return turned(x, VM(1)); }

static inline F vatan2(F y, F x) {
  F a = vabs(x), b = vabs(y);
  M steep = b > a;
  F most = SELECT(steep, a, b), least = SELECT(steep, b, a);
  M far = least > (REAL)0.414213562373095 * most;
  F over = SELECT(far, least, least - most), under = SELECT(far, most, least + most);
  F t = over / SELECT(under == 0, under, VF(1));
  F z = t * t;
  F r = t + t * z * ((REAL)-3.33329491539e-1
      + z * ((REAL)1.99777106478e-1 + z * ((REAL)-1.38776856032e-1 + z * (REAL)8.05374449538e-2)));
  r = r + SELECT(far, VF(0), VF(0.785398163397448309616));
  r = SELECT(steep, r, (REAL)1.57079632679489661923 - r);
  r = SELECT((M)x < 0, r, (REAL)3.14159265358979323846 - r);
  r = (F)((M)r | ((M)y & SIGN));
  return SELECT((x != x) | (y != y), r, x + y);
}
static inline F vatan(F x) { return vatan2(x, VF(1)); }

static inline F arc(F s, F z) {
  return s + s * z * ((REAL)1.6666752422e-1 + z * ((REAL)7.4953002686e-2
      + z * ((REAL)4.5470025998e-2 + z * ((REAL)2.4181311049e-2 + z * (REAL)4.2163199048e-2))));
}
static inline F vasin(F x) {
  F a = vabs(x);
  M big = a > (REAL)0.5;
  F z = SELECT(big, a * a, (REAL)0.5 * (1 - a));
  F p = arc(SELECT(big, a, vsqrt(z)), z);
  p = SELECT(big, p, (REAL)1.57079632679489661923 - 2 * p);
  return (F)((M)p | ((M)x & SIGN));
}
static inline F vacos(F x) {
  F a = vabs(x);
  M big = a > (REAL)0.5;
  F z = SELECT(big, a * a, (REAL)0.5 * (1 - a));
  F p = arc(SELECT(big, x, vsqrt(z)), z);
  F far = SELECT(x < 0, 2 * p, (REAL)3.14159265358979323846 - 2 * p);
  return SELECT(big, (REAL)1.57079632679489661923 - p, far);
}
#else
LANEWISE(vsqrt, sqrt) LANEWISE(vfloor, floor) LANEWISE(vceil, ceil) LANEWISE(vround, rint) LANEWISE(vexp, exp)
LANEWISE(vlog, log) LANEWISE(vlog1p, log1p) LANEWISE(vtan, tan) LANEWISE(vtanh, tanh) LANEWISE2(vpow, pow) LANEWISE2(vrem, fmod)
LANEWISE(vsin, sin) LANEWISE(vcos, cos) LANEWISE2(vatan2, atan2) LANEWISE(vatan, atan) LANEWISE(vasin, asin)
LANEWISE(vacos, acos)
#endif
