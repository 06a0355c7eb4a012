"""summarize: several seeds' results as headline numbers and a row per task."""

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
    """Task to how many of its episodes succeeded."""
    episodes = [
        EpisodeResult(task, k, k < count, 5 if k < count else None, None, None)
        for task, count in hits.items()
        for k in range(trials)
    ]
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
    with pytest.raises(ValueError, match="different training seeds, 0 and 2 are one evaluation"):
        summarize([one, other, one])
    with pytest.raises(ValueError, match="of the same plans; those of seeds 0 and 1 differ"):
        summarize([replace(one, origin={"plans": "a"}), replace(other, origin={"plans": "b"})])
    summarize([replace(one, origin={"plans": "a"}), other])  # not saved yet, so it does not say
    with pytest.raises(TypeError, match=r"results\[1\] must be an EvaluationResult, got 'other'"):
        summarize([one, "other"])


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
    found = json.loads(json.dumps(summary.to_json(), allow_nan=False))
    assert {task: row["rates"] for task, row in found["tasks"].items()} == rates
    assert found["mean"]["value"] == pytest.approx(np.mean([row["mean"] for row in found["tasks"].values()]))
    assert found["mean"]["value"] == pytest.approx(np.mean(list(found["by_seed"].values())))
    assert all(row["min"] <= row["mean"] + 1e-9 <= row["max"] + 2e-9 for row in found["tasks"].values())
    assert found["solved"] == sum(row["mean"] >= 0.8 - 1e-9 for row in found["tasks"].values())


def test_table():
    lines = summarize(RESULTS).table().splitlines()
    assert lines[0].startswith("mean 0.500 [")
    assert lines[0].endswith("; 1 of 3 tasks >= 0.8; 2 seeds")
    assert lines[1].split() == ["task", "mean", "min", "max"]
    assert lines[2].split() == ["push", "0.62", "0.50", "0.75"]
    assert lines[5].split() == ["mean", "0.50", "0.50", "0.50"]
    assert len({len(line) for line in lines[1:6]}) == 1


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (make_result({"push": 3, "reach": 3}), "results must be of the same tasks; seeds 3 and 7 do not share sweep"),
        (
            make_result({"push": 3, "reach": 3, "sweep": 0}, trials=5),
            "results must share episodes_per_task, got 4 for seed 3 and 5 for seed 7",
        ),
        (
            make_result({"push": 3, "reach": 3, "sweep": 0}, noise_scale=0.0),
            "results must share noise_scale, got 0.1 for seed 3 and 0.0 for seed 7",
        ),
    ],
)
def test_results_that_cannot_be_averaged_raise(other, message):
    with pytest.raises(ValueError, match=message):
        summarize({3: RESULTS[3], 7: other})


@pytest.mark.parametrize(
    ("rates", "seeds", "message"),
    [
        ({}, None, "rates must hold at least one task"),
        ({"push": []}, None, "rates must hold at least one task, each with at least one rate"),
        ({"push": [0.5], "reach": [0.5, 0.6]}, None, "got different numbers: {'push': 1, 'reach': 2}"),
        ({"push": [1.5]}, None, r"rates must be rates in \[0, 1\], got 1.5"),
        ({"push": [0.5, 0.6]}, [1], r"seeds must be 2 different names, got \('1',\)"),
        ({"push": [0.5, 0.6]}, [1, "1"], r"seeds must be 2 different names, got \('1', '1'\)"),
    ],
)
def test_wrong_rates_raise(rates, seeds, message):
    with pytest.raises(ValueError, match=message):
        summarize_rates(rates, seeds=seeds)
