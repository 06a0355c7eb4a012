"""summarize: results of several seeds as mean, interquartile mean, solved tasks and a row per task."""

import json

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import lw_torchrl as lw
from benchmarks.statistics import TaskSummary, interquartile_mean, mean_rate, summarize, summarize_rates
from lw_torchrl.evaluation import EpisodeResult


def make_result(hits, trials=4, **config):
    """Make a result from the number of successes of each task."""
    steps = [(task, k, 5 if k < count else None) for task, count in hits.items() for k in range(trials)]
    episodes = [EpisodeResult(task, k, step is not None, step, None, None) for task, k, step in steps]
    settings = {"tasks": list(hits), "episodes_per_task": trials, "seed": 0, "noise_scale": 0.1, "max_steps": 500}
    return lw.EvaluationResult({**settings, **config}, tuple(episodes))


RESULTS = {3: make_result({"push": 2, "reach": 4, "sweep": 0}), 7: make_result({"push": 3, "reach": 3, "sweep": 0})}


def test_numbers_are_those_computed_by_hand():
    summary = summarize(RESULTS)
    assert summary.mean.value == pytest.approx(0.5)
    assert summary.solved == 1
    assert summary.per_task["push"] == TaskSummary(mean=0.625, min=0.5, max=0.75)
    assert summary.by_seed == {"3": 0.5, "7": 0.5}
    assert summary.array.tolist() == [[0.5, 1.0, 0.0], [0.75, 0.75, 0.0]]
    assert summary.iqm == interquartile_mean(summary.array)
    assert summary.mean == mean_rate(summary.array)


@settings(max_examples=40, deadline=None)
@given(
    st.integers(1, 4).flatmap(
        lambda seeds: st.dictionaries(
            st.text(min_size=1, max_size=5),
            st.lists(st.floats(0, 1), min_size=seeds, max_size=seeds),
            min_size=1,
            max_size=8,
        )
    )
)
@example({"0": [0.0, 1e-151]})
def test_summary_is_json_and_consistent(rates):
    summary = summarize_rates(rates)
    document = json.loads(json.dumps(summary.to_json(), allow_nan=False))
    rows = document["tasks"].values()
    assert {task: row["rates"] for task, row in document["tasks"].items()} == rates
    assert document["mean"]["value"] == pytest.approx(np.mean([row["mean"] for row in rows]))
    assert document["mean"]["value"] == pytest.approx(np.mean(list(document["by_seed"].values())))
    assert all(row["min"] <= row["mean"] + 1e-9 <= row["max"] + 2e-9 for row in rows)
    assert document["solved"] == sum(row["mean"] >= 0.8 - 1e-9 for row in rows)
