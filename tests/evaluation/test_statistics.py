"""Statistics over seeds × tasks: against scipy, by hand, and intervals that hold the truth as often as they say."""

from __future__ import annotations

import json
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.stats import mannwhitneyu, trim_mean

from lw_torchrl.evaluation import (
    count_solved,
    interquartile_mean,
    mean_difference,
    mean_rate,
    probability_of_improvement,
)
from lw_torchrl.evaluation.statistics import Estimate

ONE = [mean_rate, interquartile_mean]
TWO = [mean_difference, probability_of_improvement]
FEW = {"resamples": 50}


def rates(least_seeds=1, tasks=None):
    """(seeds, tasks) in steps of a twentieth, as 20 episodes give: with many ties."""
    shapes = st.tuples(st.integers(least_seeds, 6), st.integers(1, 12) if tasks is None else tasks)
    return shapes.flatmap(lambda shape: arrays(np.int64, shape, elements=st.integers(0, 20))).map(lambda x: x / 20)


@st.composite
def pairs(draw):
    tasks = st.just(draw(st.integers(1, 8)))
    return draw(rates(tasks=tasks)), draw(rates(tasks=tasks))


@given(rates())
def test_the_interquartile_mean_is_scipys(x):
    assert interquartile_mean(x, **FEW).value == pytest.approx(trim_mean(x, 0.25, axis=None))


@settings(deadline=None)  # scipy's first call is slow
@given(pairs())
def test_the_probability_of_improvement_is_scipys(pair):
    x, y = pair
    expected = mannwhitneyu(x, y, axis=0, method="asymptotic").statistic.mean() / (len(x) * len(y))
    assert probability_of_improvement(x, y, **FEW).value == pytest.approx(expected)


@pytest.mark.parametrize(
    ("x", "y", "expected"),
    [
        ([[0.9, 0.9], [0.8, 1.0]], [[0.1, 0.2], [0.3, 0.0]], 1.0),
        ([[0.1, 0.2], [0.3, 0.0]], [[0.9, 0.9], [0.8, 1.0]], 0.0),
        ([[0.5, 0.5]] * 3, [[0.5, 0.5]] * 2, 0.5),
        ([[1.0, 0.0]] * 2, [[0.0, 1.0]] * 2, 0.5),
        ([[1.0, 0.5]] * 2, [[0.0, 0.5]] * 2, 0.75),
    ],
)
def test_the_probability_of_improvement_by_hand(x, y, expected):
    found = probability_of_improvement(x, y)
    assert (found.value, found.low, found.high) == (expected,) * 3


@given(pairs())
def test_a_comparison_the_other_way_round_is_its_mirror(pair):
    x, y = pair
    there, back = (mean_difference(*order, **FEW).value for order in ((x, y), (y, x)))
    assert there == pytest.approx(-back)
    there, back = (probability_of_improvement(*order, **FEW).value for order in ((x, y), (y, x)))
    assert there == pytest.approx(1 - back)


@given(pairs(), st.sampled_from(TWO), st.booleans(), st.booleans(), st.randoms(use_true_random=False))
def test_an_order_of_the_seeds_does_not_matter_and_intervals_stay_in_range(pair, function, whole, tasks, random):
    x, y = pair
    found = function(x, y, **FEW, whole_seeds=whole, resample_tasks=tasks)
    shuffled = random.sample(range(len(x)), len(x))
    assert function(x[shuffled], y, **FEW).value == pytest.approx(found.value)
    if min(len(x), len(y)) == 1:
        assert found.low is found.high is None
    else:
        bottom = 0 if function is probability_of_improvement else -1
        assert bottom - 1e-9 <= found.low <= found.high <= 1 + 1e-9


@given(rates(least_seeds=2), st.sampled_from(ONE), st.booleans(), st.booleans())
def test_an_interval_stays_among_the_rates(x, function, whole, tasks):
    found = function(x, **FEW, whole_seeds=whole, resample_tasks=tasks)
    assert x.min() - 1e-9 <= found.low <= found.high <= x.max() + 1e-9
    assert x.min() - 1e-9 <= found.value <= x.max() + 1e-9


@settings(max_examples=30)
@given(rates(least_seeds=2), st.sampled_from(ONE))
def test_more_confidence_never_narrows(x, function):
    narrow, wide = function(x, **FEW, confidence=0.5), function(x, **FEW, confidence=0.99)
    assert wide.low <= narrow.low
    assert narrow.high <= wide.high


def holds(function, truth, draw, repeats=400, **options):
    rng = np.random.default_rng(3)
    found = [function(*draw(rng), resamples=300, seed=k, **options) for k in range(repeats)]
    return np.mean([estimate.low <= truth <= estimate.high for estimate in found])


P = np.random.default_rng(0).random(20)
Q = 0.8 * P


def test_intervals_hold_the_truth_in_about_95_of_100_cases():
    """With 20 seeds; 400 repeats make a standard error of 0.011, 300 resamples cost about 0.01."""
    x = lambda rng: rng.binomial(20, P, (20, 20)) / 20  # noqa: E731
    y = lambda rng: rng.binomial(20, Q, (20, 20)) / 20  # noqa: E731
    assert holds(mean_rate, P.mean(), lambda rng: [x(rng)]) == pytest.approx(0.94, abs=0.03)
    difference = holds(mean_difference, (P - Q).mean(), lambda rng: [x(rng), y(rng)])
    assert difference == pytest.approx(0.94, abs=0.03)


def test_the_interval_of_the_probability_of_improvement_holds_the_truth():
    """X is uniform on [0.2, 1], Y on [0, 0.8]: Y is above X with probability 0.75² / 2."""
    found = holds(
        probability_of_improvement,
        1 - 0.75**2 / 2,
        lambda rng: [0.2 + 0.8 * rng.random((20, 5)), 0.8 * rng.random((20, 5))],
        repeats=300,
    )
    assert found == pytest.approx(0.94, abs=0.04)


def test_few_seeds_are_too_narrow_as_documented():
    three = holds(mean_rate, P.mean(), lambda rng: [rng.binomial(20, P, (3, 20)) / 20])
    assert 0.82 < three < 0.92


def test_whole_seeds_are_for_seeds_that_move_all_tasks_alike():
    draw = lambda rng: [np.clip(0.5 + 0.05 * rng.standard_normal((20, 1)) + np.zeros((20, 30)), 0, 1)]  # noqa: E731
    assert holds(mean_rate, 0.5, draw) < 0.5
    assert holds(mean_rate, 0.5, draw, whole_seeds=True) == pytest.approx(0.93, abs=0.04)


def test_resampling_tasks_asks_about_other_tasks():
    rng = np.random.default_rng(0)
    x = np.clip(P + 0.02 * rng.standard_normal((5, 20)), 0, 1)
    these, alike = mean_rate(x), mean_rate(x, resample_tasks=True)
    assert alike.high - alike.low > 4 * (these.high - these.low)
    # Tasks are paired: what both methods find hard widens nothing.
    difference = mean_difference(x, x * 0 + np.clip(P - 0.1, 0, 1), resample_tasks=True)
    assert difference.high - difference.low < 0.3 * (alike.high - alike.low)


@pytest.mark.parametrize("function", [*ONE, *TWO])
def test_a_seed_gives_the_same_interval_and_another_one_another(function):
    rng = np.random.default_rng(1)
    methods = [rng.random((4, 13)) for _ in range(1 if function in ONE else 2)]
    assert function(*methods, seed=5) == function(*methods, seed=5)
    assert function(*methods, seed=5) != function(*methods, seed=6)
    assert function(*methods, seed=5).value == function(*methods, seed=6).value


@pytest.mark.parametrize("function", [*ONE, *TWO])
def test_ten_thousand_resamples_are_fast(function):
    rng = np.random.default_rng(1)
    methods = [rng.random((5, 50)) for _ in range(1 if function in ONE else 2)]
    start = time.perf_counter()
    function(*methods, resamples=10_000)
    assert time.perf_counter() - start < 5  # a fraction of a second on an idle core


def test_memory_bounds_change_nothing_but_the_draw(monkeypatch):
    x = np.random.default_rng(1).random((4, 13))
    whole = mean_rate(x)
    monkeypatch.setattr("lw_torchrl.evaluation.statistics._CHUNK", 5000)
    pieces = mean_rate(x)
    assert pieces.low == pytest.approx(whole.low, abs=0.01)
    assert pieces.high == pytest.approx(whole.high, abs=0.01)


def test_tasks_solved_are_counted_at_the_threshold():
    assert count_solved([[0.8, 0.79, 1.0], [0.8, 0.8, 0.6]]) == 2
    assert count_solved([[0.75], [0.85], [0.8]]) == 1  # their float mean is below 0.8
    assert count_solved([[0.5, 0.4]], threshold=0.5) == 1


def test_an_estimate_reads_well_and_is_json():
    assert str(Estimate(0.5, 0.4, 0.6)) == "0.500 [0.400, 0.600]"
    assert str(mean_rate([[0.5, 1.0]])) == "0.750"
    assert json.loads(json.dumps(mean_rate([[0.5, 1.0]]).to_json())) == {"value": 0.75, "low": None, "high": None}


@pytest.mark.parametrize(
    ("given_rates", "error", "message"),
    [
        ([0.5, 0.6], ValueError, r"rates must have shape \(seeds, tasks\), both at least 1, got \(2,\)"),
        (np.zeros((3, 0)), ValueError, r"rates must have shape .* got \(3, 0\)"),
        ([[0.5, 1.5]], ValueError, r"rates must be rates in \[0, 1\], got 1.5"),
        ([[0.5, float("nan")]], ValueError, r"rates must be rates in \[0, 1\], got nan"),
        ([[0.5], [0.5, 0.6]], TypeError, "rates must be an array of numbers"),
        ([["half"]], TypeError, "rates must be an array of numbers"),
    ],
)
@pytest.mark.parametrize("function", [*ONE, count_solved])
def test_wrong_rates_are_refused(function, given_rates, error, message):
    with pytest.raises(error, match=message):
        function(given_rates)


@pytest.mark.parametrize("function", TWO)
def test_methods_need_the_same_tasks(function):
    with pytest.raises(ValueError, match="y must have x's tasks, 2 columns, got 3"):
        function([[0.5, 0.5]], [[0.5, 0.5, 0.5]])
    with pytest.raises(ValueError, match=r"y must be rates in \[0, 1\], got -1.0"):
        function([[0.5]], [[-1.0]])


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"resamples": 0}, ValueError, "resamples must be at least 1, got 0"),
        ({"resamples": 1.5}, TypeError, "resamples must be an integer"),
        ({"seed": -1}, ValueError, "seed must be at least 0, got -1"),
        ({"confidence": 95}, ValueError, r"confidence must be in \(0, 1\), got 95"),
    ],
)
def test_wrong_options_are_refused(options, error, message):
    with pytest.raises(error, match=message):
        mean_rate([[0.5], [0.6]], **options)


def test_a_wrong_threshold_is_refused():
    with pytest.raises(ValueError, match=r"threshold must be in \(0, 1\], got 80"):
        count_solved([[0.5]], threshold=80)
