"""summarize: results of several seeds as mean, interquartile mean, solved tasks and a row per task."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import lw_torchrl as lw
from benchmarks.statistics import Estimate, TaskSummary, interquartile_mean, mean_rate, summarize, summarize_rates
from lw_torchrl.evaluation import EpisodeResult

RATES = {"push": [0.5, 0.75], "reach": [1.0, 0.75], "sweep": [0.0, 0.0]}


def make_result(hits, trials=4, **config):
    """Make a result from the number of successes of each task."""
    steps = [(task, k, 5 if k < count else None) for task, count in hits.items() for k in range(trials)]
    episodes = [EpisodeResult(task, k, step is not None, step, None, None) for task, k, step in steps]
    settings = {"tasks": list(hits), "episodes_per_task": trials, "seed": 0, "noise_scale": 0.1, "max_steps": 500}
    return lw.EvaluationResult({**settings, **config}, tuple(episodes))


RESULTS = {3: make_result({"push": 2, "reach": 4, "sweep": 0}), 7: make_result({"push": 3, "reach": 3, "sweep": 0})}


def test_results_and_rates_give_the_same_summary():
    summary = summarize(RESULTS)
    assert summary == summarize_rates(RATES, seeds=[3, 7])
    assert summary.seeds == ("3", "7")
    assert summarize(list(RESULTS.values())).seeds == ("0", "1")


def test_numbers_are_those_computed_by_hand():
    summary = summarize(RESULTS)
    assert summary.mean.value == pytest.approx(0.5)
    assert summary.solved == 1
    assert summary.per_task["push"] == TaskSummary(mean=0.625, min=0.5, max=0.75)
    assert summary.by_seed == {"3": 0.5, "7": 0.5}
    assert summary.array.tolist() == [[0.5, 1.0, 0.0], [0.75, 0.75, 0.0]]
    assert summary.iqm == interquartile_mean(summary.array)
    assert summary.mean == mean_rate(summary.array)


def test_repeated_results_and_other_plans_raise():
    one, other = RESULTS.values()
    with pytest.raises(ValueError, match=r"^results .*0 and 2"):
        summarize([one, other, one])
    with pytest.raises(ValueError, match=r"^results .*plans.*0 and 1"):
        summarize([replace(one, origin={"plans": "a"}), replace(other, origin={"plans": "b"})])
    summarize([replace(one, origin={"plans": "a"}), other])  # unsaved results do not name their plans


def test_one_seed_has_no_interval():
    summary = summarize([RESULTS[3]])
    assert summary.mean == Estimate(0.5)
    assert summarize(RESULTS, threshold=0.6, confidence=0.5).solved == 2
    assert "mean 0.500, IQM 0.500; 1 of 3 tasks >= 0.8; 1 seed" in summary.table()


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


def test_table():
    lines = summarize(RESULTS).table().splitlines()
    assert lines[0].startswith("mean 0.500 [")
    assert lines[0].endswith("; 1 of 3 tasks >= 0.8; 2 seeds")
    assert lines[1].split() == ["task", "mean", "min", "max"]
    assert lines[2].split() == ["push", "0.62", "0.50", "0.75"]
    assert lines[5].split() == ["mean", "0.50", "0.50", "0.50"]
    assert len({len(line) for line in lines[1:6]}) == 1


@pytest.mark.parametrize(
    ("hits", "options", "named"),
    [
        ({"push": 3, "reach": 3}, {}, "sweep"),
        ({"push": 3, "reach": 3, "sweep": 0}, {"trials": 5}, "episodes_per_task"),
        ({"push": 3, "reach": 3, "sweep": 0}, {"noise_scale": 0.0}, "noise_scale"),
    ],
)
def test_results_that_cannot_be_averaged_raise(hits, options, named):
    with pytest.raises(ValueError, match=f"^results must .*{named}"):
        summarize({3: RESULTS[3], 7: make_result(hits, **options)})


@pytest.mark.parametrize(
    ("argument", "rates", "seeds"),
    [
        ("rates", {}, None),
        ("rates", {"push": []}, None),
        ("rates", {"push": [0.5], "reach": [0.5, 0.6]}, None),
        ("rates", {"push": [1.5]}, None),
        ("seeds", {"push": [0.5, 0.6]}, [1]),
        ("seeds", {"push": [0.5, 0.6]}, [1, "1"]),
    ],
)
def test_wrong_rates_raise(argument, rates, seeds):
    with pytest.raises(ValueError, match=f"^{argument} must "):
        summarize_rates(rates, seeds=seeds)
