"""The pure tick as machine code: traced, taken apart into scalars, printed as C, compiled and called.

interpret   jaxpr of one lane -> graph, by one rule for every primitive (elementwise, moves, lookups, sums, noise,
            control)
graph, fold scalars, each computed once, simplified
program     what is needed, how often it changes, in which order
evaluate    the program in NumPy
to_c, build, machine   as C with vector extensions, compiled, called on states
trace, backend         of a simulation; compared with XLA; whole segments
"""
