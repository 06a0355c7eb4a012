"""Statistics over seeds × tasks, and summaries: against scipy, by hand, and how often intervals contain the truth."""

import json

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.stats import mannwhitneyu, t, trim_mean, ttest_ind

import lw_torchrl as lw
from benchmarks import statistics as over
from benchmarks.statistics import Estimate, TaskSummary, mean_difference, mean_rate, probability_of_improvement
from lw_torchrl.evaluation import EpisodeResult

TWO = [mean_difference, probability_of_improvement]


def rates(least_seeds=1, tasks=None):
    """Rates (seeds, tasks) in steps of 1/20, as of 20 episodes, with many ties."""
    shapes = st.tuples(st.integers(least_seeds, 6), st.integers(1, 12) if tasks is None else tasks)
    return shapes.flatmap(lambda shape: arrays(np.int64, shape, elements=st.integers(0, 20))).map(lambda x: x / 20)


@st.composite
def pairs(draw):
    tasks = st.just(draw(st.integers(1, 8)))
    return draw(rates(tasks=tasks)), draw(rates(tasks=tasks))


@given(rates())
def test_interquartile_mean_is_scipys(x):
    assert over.interquartile_mean(x).value == pytest.approx(trim_mean(x, 0.25, axis=None))


@settings(deadline=None)  # scipy's first call is slow
@given(pairs())
def test_probability_of_improvement_is_scipys(pair):
    x, y = pair
    expected = mannwhitneyu(x, y, axis=0, method="asymptotic").statistic.mean() / (len(x) * len(y))
    assert probability_of_improvement(x, y).value == pytest.approx(expected)


@given(pairs(), st.sampled_from(TWO), st.randoms(use_true_random=False))
def test_order_of_seeds_does_not_matter_and_intervals_stay_in_range(pair, function, random):
    x, y = pair
    estimate = function(x, y)
    again = function(x[random.sample(range(len(x)), len(x))], y)
    assert again.value == pytest.approx(estimate.value)
    if min(len(x), len(y)) == 1:
        assert estimate.low is estimate.high is None
    else:
        bottom = 0 if function is probability_of_improvement else -1
        assert bottom <= estimate.low <= estimate.value + 1e-9
        assert estimate.value - 1e-9 <= estimate.high <= 1
        assert (again.low, again.high) == (pytest.approx(estimate.low), pytest.approx(estimate.high))


@settings(deadline=None)
@given(rates(least_seeds=2), st.sampled_from([0.5, 0.95]))
def test_interval_of_a_mean_is_scipys_student_interval_over_seeds(x, confidence):
    estimate, seeds = mean_rate(x, confidence=confidence), x.mean(1)
    error = seeds.std(ddof=1) / len(seeds) ** 0.5
    low, high = t.interval(confidence, len(seeds) - 1, seeds.mean(), error) if error else (seeds.mean(),) * 2
    assert (estimate.low, estimate.high) == (pytest.approx(max(low, 0)), pytest.approx(min(high, 1)))


@settings(deadline=None)
@given(pairs())
def test_interval_of_a_difference_is_that_of_scipys_welch_test(pair):
    seeds = [x.mean(1) for x in pair]
    estimate = mean_difference(*pair)
    if min(map(len, seeds)) > 1 and min(x.std() for x in seeds) > 1e-9:
        expected = ttest_ind(*seeds, equal_var=False).confidence_interval(0.95)
        bounds = pytest.approx(max(expected.low, -1)), pytest.approx(min(expected.high, 1))
        assert (estimate.low, estimate.high) == bounds


def coverage(function, truth, draw, repeats=400):
    """Return how often the interval contains the truth."""
    rng = np.random.default_rng(3)
    estimates = [function(*draw(rng)) for _ in range(repeats)]
    return np.mean([estimate.low <= truth <= estimate.high for estimate in estimates])


@pytest.mark.parametrize("seeds", [1, 3, 5])
def test_interval_over_tasks_contains_the_mean_over_all_tasks(seeds):
    """Tasks, seeds and the episodes of each are drawn; with one seed, seeds do not differ."""
    spread = 0.05 if seeds > 1 else 0.0

    def draw(rng):
        tasks, offsets = rng.normal(0.1, 0.2, 20), spread * rng.normal(size=(seeds, 1))
        return [tasks + offsets + rng.normal(0.0, 0.1, (seeds, 20))]

    assert coverage(lambda x: over.mean_over_tasks(x, draws=1000), 0.1, draw) == pytest.approx(0.94, abs=0.03)


def test_interval_over_tasks_of_equal_values_is_that_value():
    estimate = over.mean_over_tasks(np.full((3, 4), 0.25))
    assert (estimate.value, estimate.low, estimate.high) == pytest.approx((0.25, 0.25, 0.25))


def test_interval_of_the_probability_of_improvement_contains_the_truth():
    """X is uniform on [0.2, 1], Y on [0, 0.8]: Y is above X with probability 0.75² / 2."""
    draw = lambda rng: [0.2 + 0.8 * rng.random((5, 5)), 0.8 * rng.random((5, 5))]  # noqa: E731
    assert coverage(probability_of_improvement, 1 - 0.75**2 / 2, draw, repeats=300) == pytest.approx(0.95, abs=0.04)


def test_tasks_solved_are_counted_at_the_threshold():
    assert over.count_solved([[0.8, 0.79, 1.0], [0.8, 0.8, 0.6]]) == 2
    assert over.count_solved([[0.75], [0.85], [0.8]]) == 1  # their float mean is below 0.8
    assert over.count_solved([[0.5, 0.4]], threshold=0.5) == 1


def test_estimate_is_text_and_json():
    assert str(mean_rate([[0.762], [0.767], [0.790]])) == "0.773 [0.736, 0.810]"
    assert (str(Estimate(0.5, 0.4, 0.6)), str(mean_rate([[0.5, 1.0]]))) == ("0.500 [0.400, 0.600]", "0.750")
    assert json.loads(json.dumps(mean_rate([[0.5, 1.0]]).to_json())) == {"value": 0.75, "low": None, "high": None}


def make_result(hits, trials=4):
    """Make a result from the number of successes of each task."""
    steps = [(task, k, 5 if k < count else None) for task, count in hits.items() for k in range(trials)]
    episodes = (EpisodeResult(task, k, step is not None, step, None, None) for task, k, step in steps)
    return lw.EvaluationResult({"tasks": list(hits), "episodes_per_task": trials, "max_steps": 500}, tuple(episodes))


RESULTS = {3: make_result({"push": 2, "reach": 4, "sweep": 0}), 7: make_result({"push": 3, "reach": 3, "sweep": 0})}


def test_numbers_are_those_computed_by_hand():
    summary = over.summarize(RESULTS)
    assert (summary.mean.value, summary.solved) == (pytest.approx(0.5), 1)
    assert summary.per_task["push"] == TaskSummary(mean=0.625, min=0.5, max=0.75)
    assert (summary.by_seed, summary.array.tolist()) == ({"3": 0.5, "7": 0.5}, [[0.5, 1.0, 0.0], [0.75, 0.75, 0.0]])
    assert (summary.iqm, summary.mean) == (over.interquartile_mean(summary.array), mean_rate(summary.array))


def rates_by_task(seeds):
    lists = st.lists(st.floats(0, 1), min_size=seeds, max_size=seeds)
    return st.dictionaries(st.text(min_size=1, max_size=5), lists, min_size=1, max_size=8)


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 4).flatmap(rates_by_task))
@example({"0": [0.0, 1e-151]})
def test_summary_is_json_and_consistent(rates):
    document = json.loads(json.dumps(over.summarize_rates(rates).to_json(), allow_nan=False))
    rows = document["tasks"].values()
    assert {task: row["rates"] for task, row in document["tasks"].items()} == rates
    assert document["mean"]["value"] == pytest.approx(np.mean([row["mean"] for row in rows]))
    assert document["mean"]["value"] == pytest.approx(np.mean(list(document["by_seed"].values())))
    assert all(row["min"] <= row["mean"] + 1e-9 <= row["max"] + 2e-9 for row in rows)
    assert document["solved"] == sum(row["mean"] >= 0.8 - 1e-9 for row in rows)
