"""Numbers read out of a table of walks: against published examples, hand counts and planted causes."""

import fractions
import itertools
import math

import numpy as np
import polars as pl
import pytest

from jaxbiped.batch import intervals, summary


def walks(variant: str, successes, **columns) -> pl.DataFrame:
    successes = [bool(s) for s in successes]
    return pl.DataFrame(
        {
            "variant": [variant] * len(successes),
            "scenario": range(len(successes)),
            **columns,
            "success": successes,
        }
    )


def paired_walks(both: int, only_first: int, only_second: int, neither: int) -> pl.DataFrame:
    first = [True] * (both + only_first) + [False] * (only_second + neither)
    second = [True] * both + [False] * only_first + [True] * only_second + [False] * neither
    return pl.concat([walks("a", first), walks("b", second).reverse()])


@pytest.mark.parametrize(
    ("successes", "n", "low", "high"),
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_wilson_is_the_score_interval_of_newcombes_examples(successes, n, low, high):
    """R. G. Newcombe, Statistics in Medicine 17 (1998) 857-872, table I, method 3."""
    assert summary.wilson(successes, n) == pytest.approx((low, high), abs=5e-5)


@pytest.mark.parametrize(("confidence", "z"), [(0.8, 1.2815516), (0.95, 1.9599640), (0.99, 2.5758293)])
@pytest.mark.parametrize(("successes", "n"), [(0, 1), (1, 1), (0, 20), (7, 20), (20, 20), (9_950, 10_000)])
def test_wilsons_ends_are_the_rates_that_are_z_deviations_away(successes, n, confidence, z):
    """(k / n - p)^2 = z^2 p (1 - p) / n, of which the ends are the roots."""
    rate = successes / n
    ends = np.sort(np.roots([1.0 + z**2 / n, -(2.0 * rate + z**2 / n), rate**2]).real)
    np.testing.assert_allclose(summary.wilson(successes, n, confidence), ends, rtol=1e-6, atol=1e-7)


def test_wilson_of_nothing_says_nothing_and_of_nonsense_fails():
    assert summary.wilson(0, 0) == (0.0, 1.0)
    for wrong in ((3, 2), (-1, 2)):
        with pytest.raises(ValueError, match="successes"):
            summary.wilson(*wrong)


def test_cells_count_per_variant_and_value_in_the_tables_order_of_variants():
    table = pl.concat(
        [
            walks("zeta", [1, 0, 1, 1], load_kg=[5.0, 5.0, 2.5, 5.0]),
            walks("alpha", [0, 0], load_kg=[2.5, 2.5]),
        ]
    )
    cells = summary.cells(table, ["load_kg"])
    assert cells.columns == ["variant", "load_kg", "n", "successes", "rate", "low", "high"]
    assert cells.select("variant", "load_kg", "n", "successes").rows() == [
        ("zeta", 2.5, 1, 1),
        ("zeta", 5.0, 3, 2),
        ("alpha", 2.5, 2, 0),
    ]
    assert cells["rate"].to_list() == pytest.approx([1.0, 2 / 3, 0.0])
    assert (cells["low"][1], cells["high"][1]) == summary.wilson(2, 3)
    assert summary.cells(table).select("variant", "n").rows() == [("zeta", 4), ("alpha", 2)]
    assert summary.cells(table.head(0), ["load_kg"]).is_empty()


def test_times_that_never_come_are_no_times():
    table = walks("a", [1, 0], load_time_s=[2.0, 1e6], load_kg=[1e6, 2.0])
    cleaned = summary.without_never(table, ["load_time_s", "load_kg"])
    assert cleaned["load_time_s"].to_list() == [2.0, None]
    assert cleaned["load_kg"].to_list() == [1e6, 2.0]


def test_newcombe_is_his_own_example():
    """Newcombe (1998), the data of Armitage and Berry: 36, 12, 2 and 0 pairs give 0.0569 to 0.3404."""
    assert summary.newcombe(36, 12, 2, 0) == pytest.approx((0.0569, 0.3404), abs=5e-5)


def test_newcombe_by_hand_with_positive_correlation():
    """1 success each in the same of 2 pairs: phi is corrected from 1 to 0, so that two Wilson intervals are squared."""
    low, high = summary.wilson(1, 2)
    half = math.hypot(0.5 - low, high - 0.5)
    assert summary.newcombe(1, 0, 0, 1) == pytest.approx((-half, half))
    phi = (8 * 6 - 1 * 5 - 10) / math.sqrt(9 * 11 * 13 * 7)
    (low1, high1), (low2, high2) = summary.wilson(9, 20), summary.wilson(13, 20)
    down, up = (0.45 - low1, high2 - 0.65), (high1 - 0.45, 0.65 - low2)
    expected = [
        -0.2 + sign * math.sqrt(a * a + b * b - 2 * phi * a * b) for sign, (a, b) in ((-1, down), (1, up))
    ]
    assert summary.newcombe(8, 1, 5, 6) == pytest.approx(expected)


@pytest.mark.parametrize("counts", [c for c in itertools.product((0, 1, 7), repeat=4) if sum(c)])
def test_newcombe_holds_the_difference_and_is_antisymmetric(counts):
    both, first, second, neither = counts
    low, high = summary.newcombe(*counts)
    difference = (first - second) / sum(counts)
    assert -1.0 - 1e-12 <= low <= difference + 1e-12 and difference - 1e-12 <= high <= 1.0 + 1e-12
    assert low < high
    assert summary.newcombe(both, second, first, neither) == pytest.approx((-high, -low))


@pytest.mark.parametrize(("first", "second"), [(0, 0), (0, 1), (5, 0), (3, 9), (4, 4), (40, 75), (900, 1100)])
def test_mcnemar_is_twice_the_tail_of_a_fair_coin(first, second):
    n = first + second
    tail = fractions.Fraction(sum(math.comb(n, k) for k in range(min(first, second) + 1)), 2**n)
    assert summary.mcnemar(first, second) == pytest.approx(float(min(1, 2 * tail)), rel=1e-9)


def test_paired_counts_scenarios_whatever_their_order():
    result = summary.paired(paired_walks(36, 12, 2, 0), "a", "b")
    # b is written backwards, so that only the scenario's number tells which rows belong together
    assert (result.both, result.only_first, result.only_second, result.neither) == (36, 12, 2, 0)
    assert (result.variant, result.against, result.n, result.unpaired) == ("a", "b", 50, 0)
    assert result.difference == pytest.approx(0.2)
    assert (result.low, result.high) == summary.newcombe(36, 12, 2, 0)
    assert result.p_value == pytest.approx(2 * (1 + 14 + 91) / 2**14)


def test_paired_means_are_those_of_the_scenarios_in_which_both_succeed():
    rng = np.random.default_rng(3)
    base, gain = rng.normal(900.0, 200.0, 60), rng.normal(-50.0, 20.0, 60)
    fell = np.arange(60) < 5
    table = pl.concat(
        [
            walks("old", np.ones(60), left_N=base, right_N=base - 30.0),
            walks("new", ~fell, left_N=base - 80.0, right_N=np.where(fell, 9e9, base + gain)).reverse(),
        ]
    )
    most = pl.max_horizontal("left_N", "right_N").alias("peak_N")
    found = summary.paired_means(table, "new", "old", most)
    gap = np.maximum(gain, -80.0)[~fell]
    assert (found.what, found.n) == ("peak_N", 55)
    assert found.difference == pytest.approx(gap.mean()) == found.mean - found.mean_against
    half = 2.005 * gap.std(ddof=1) / math.sqrt(55)  # Student's t of 54 degrees of freedom: hardly skewed
    assert (found.low, found.high) == pytest.approx((gap.mean() - half, gap.mean() + half), abs=0.15 * half)
    assert (found.low, found.high) == pytest.approx(intervals.of_mean(gap))
    few = table.filter(pl.col("scenario") < 13)
    eight = summary.paired_means(few, "new", "old", most)
    some = np.maximum(gain, -80.0)[5:13]
    half = 2.3646 * some.std(ddof=1) / math.sqrt(8)  # Student's t of 7 degrees of freedom
    assert eight.n == 8
    assert (eight.low, eight.high) == pytest.approx((some.mean() - half, some.mean() + half), rel=1e-4)
    nobody = table.with_columns(success=pl.col("variant") == "old")
    with pytest.raises(ValueError, match="both succeed"):
        summary.paired_means(nobody, "new", "old", most)


def test_paired_leaves_out_what_only_one_variant_met_and_refuses_what_cannot_be_paired():
    table = pl.concat([walks("a", [1, 1, 0]), walks("b", [0, 1])])
    result = summary.paired(table, "a", "b")
    assert (result.n, result.unpaired, result.both, result.only_first) == (2, 1, 1, 1)
    with pytest.raises(ValueError, match="no variant 'c'; there are a, b"):
        summary.paired(table, "a", "c")
    with pytest.raises(ValueError, match="more than once"):
        summary.paired(pl.concat([table, walks("b", [1])]), "a", "b")
    apart = table.with_columns(scenario=pl.int_range(pl.len()))
    with pytest.raises(ValueError, match="no scenario in common"):
        summary.paired(apart, "a", "b")


def rates(variant: str, by: dict[float, dict[float, int]], what: str, over: str) -> pl.DataFrame:
    """Twenty walks at each value, of which so many succeed."""
    rows = [(o, w, i < n) for o, cell in by.items() for w, n in cell.items() for i in range(20)]
    return walks(
        variant, [s for *_, s in rows], **{what: [w for _, w, _ in rows], over: [o for o, *_ in rows]}
    )


def test_frontier_ends_where_the_rate_first_falls_short():
    cells = {
        1.0: {2.5: 20, 5.0: 19, 7.5: 10, 10.0: 9, 12.5: 20},
        2.0: {2.5: 18, 5.0: 20, 7.5: 20, 10.0: 20, 12.5: 20},
        3.0: {2.5: 9, 5.0: 20},
    }
    table = rates("a", cells, "load_kg", "load_time_s").sample(fraction=1.0, shuffle=True, seed=1)
    limits = summary.frontier(table)
    assert limits.columns == [
        "variant",
        "load_time_s",
        "direction",
        "level",
        "load_kg",
        "low",
        "high",
        "beyond",
    ]
    # Wilson: of 20, 20 are 84 % at least, 19 76 % and at most 99 %, 18 97 %, 10 30 % to 70 %, 9 66 % at most.
    assert limits.drop("variant", "direction").rows() == [
        (1.0, 0.95, 5.0, None, 7.5, False),
        (1.0, 0.5, 7.5, 5.0, None, False),
        (2.0, 0.95, None, None, None, False),
        (2.0, 0.5, 12.5, 12.5, None, True),
        (3.0, 0.95, None, None, 2.5, False),
        (3.0, 0.5, None, None, None, False),
    ]


def test_the_interval_of_a_limit_holds_the_true_one():
    """Success falls with the load, by a logistic law: of 400 tables, at least 95 % say where the limit truly is."""
    rng, loads, n = np.random.default_rng(5), np.arange(1.0, 11.0), 30
    rate = 1.0 / (1.0 + np.exp((loads - 6.2) / 0.9))
    held, widths = {0.5: 0, 0.8: 0}, []
    for _ in range(400):
        walked = [
            walks("a", rng.random(n) < p, load_kg=np.full(n, load))
            for p, load in zip(rate, loads, strict=True)
        ]
        table = pl.concat(walked)
        for row in summary.frontier(table, by=None, levels=tuple(held)).iter_rows(named=True):
            true = loads[rate >= row["level"]].max()
            low, high = row["low"] or 0.0, row["high"] or np.inf
            assert low <= row["load_kg"] < high
            held[row["level"]] += low <= true < high
            widths.append(high - low)
    assert all(count >= 0.95 * 400 for count in held.values()), held
    assert np.median(widths) <= 4.0


def test_signed_frontier_goes_both_ways_from_zero():
    heights = {-0.04: 0, -0.02: 20, 0.0: 20, 0.02: 20, 0.04: 20}
    both = rates("both", {1.0: heights}, "step_2_height_m", "friction")
    upward = rates("up", {1.0: {0.02: 20, 0.04: 0}}, "step_2_height_m", "friction")
    table = pl.concat([both, upward])
    limits = summary.frontier(table, "step_2_height_m", None, (0.95,), signed=True)
    assert limits.rows() == [
        ("both", "up", 0.95, 0.04, None, None, True),
        ("both", "down", 0.95, -0.02, None, -0.04, False),
        ("up", "up", 0.95, 0.02, None, 0.04, False),
    ]
    unsigned = summary.frontier(table, "step_2_height_m", None, (0.95,))
    assert unsigned["step_2_height_m"].to_list() == [None, 0.02]


def test_frontier_leaves_out_walks_without_the_event():
    table = walks("a", [1, 0], load_kg=[2.5, 0.0], load_time_s=[2.0, 1e6])
    assert summary.frontier(table, levels=(0.5,))["load_kg"].to_list() == [2.5]


def planted(n: int = 4_000) -> pl.DataFrame:
    """Friction alone decides in variant a, and in variant b half of the walks fail whatever they meet."""
    rng = np.random.default_rng(0)
    columns = {
        "load_kg": rng.uniform(0, 20, n),
        "friction": rng.uniform(0.2, 1.0, n),
        "step_1_height_m": rng.choice([-0.02, 0.0, 0.02], n),
        "com_x_m": np.full(n, 0.01),
        "seed": rng.integers(0, 2**31, n),
    }
    outcome = {"peak_pitch_deg": rng.normal(size=n)}
    decided = walks("a", columns["friction"] > 0.6, **columns, **outcome)
    return pl.concat([decided, walks("b", rng.random(n) < 0.5, **columns, **outcome)])


def test_causes_find_the_input_that_decides():
    found = summary.causes(planted())
    assert sorted(found["input"].unique()) == [
        "friction",
        "load_kg",
        "step_1_height_m",
    ]  # what varies, and was given
    first = found.row(0, named=True)
    assert (first["variant"], first["input"], first["bins"]) == ("a", "friction", 8)
    assert first["information_bits"] == pytest.approx(1.0, abs=0.08)
    assert first["share"] == pytest.approx(1.0, abs=0.08)
    assert (first["rate_lowest"], first["rate_highest"]) == (0.0, 1.0)
    assert (first["lowest_to"], first["highest_from"]) == pytest.approx((0.3, 0.9), abs=0.02)
    for row in found[1:].iter_rows(named=True):
        assert 0.0 <= row["information_bits"] < 3e-3
    for _, rows in found.group_by("variant"):
        assert rows["information_bits"].is_sorted(descending=True)
    heights = found.filter(variant="b", input="step_1_height_m").row(0, named=True)
    assert (heights["bins"], heights["lowest_to"], heights["highest_from"]) == (3, -0.02, 0.02)


def test_causes_take_missing_values_for_a_part_of_their_own():
    """Whoever was loaded fell: that no load ever came is what saved the others."""
    loaded = np.arange(400) % 2 == 0
    table = walks("a", ~loaded, load_time_s=np.where(loaded, 2.0 + np.arange(400) / 400, 1e6))
    row = summary.causes(table).row(0, named=True)
    assert row["information_bits"] == pytest.approx(1.0, abs=0.02)
    assert (row["rate_lowest"], row["rate_highest"], row["bins"]) == (0.0, 0.0, 9)
    assert row["highest_from"] < 3.0


def test_causes_of_nothing_are_none():
    found = summary.causes(planted().head(0))
    assert found.is_empty() and "information_bits" in found.columns
    always = summary.causes(walks("a", [1] * 50, friction=np.linspace(0.2, 1.0, 50)))
    assert always.select("information_bits", "share").rows() == [(0.0, 0.0)]


def test_information_is_corrected_for_the_number_of_walks():
    """Uncorrected, 8 bins without influence seem to tell 7 / (2 n ln 2) bits on average."""
    rng, n = np.random.default_rng(3), 200
    plain = 7 / (2 * n * math.log(2.0))
    told = [summary.information(rng.integers(0, 8, n), rng.integers(0, 2, n)) for _ in range(400)]
    assert min(told) >= 0.0
    assert np.mean(told) < 0.5 * plain
    same = np.repeat([0, 1], 100)
    assert summary.information(same, same) == pytest.approx(1.0 + 1 / (2 * n * math.log(2.0)))


def test_only_declared_inputs_are_inputs():
    table = walks("a", [1, 0], friction=[0.5, 0.6], step_2_height_m=[0.0, 0.01], peak_roll_deg=[1.0, 2.0])
    odd = table.with_columns(new_outcome_N=pl.Series([1.0, 2.0]), seed=pl.Series([1, 2]))
    assert summary.inputs(odd) == ["friction", "step_2_height_m"]
    assert "new_outcome_N" not in set(summary.causes(odd)["input"])
