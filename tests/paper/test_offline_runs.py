"""Offline experiments: what runs are called and depend on, the data they share, and that they carry on."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from lw_torchrl.paper.offline import DISTRIBUTIONS, Advantages, BehaviourDataset, OfflineRun, offline_runs, write_table
from lw_torchrl.paper.recipes import (
    MIXTURES,
    NOISE,
    OFFLINE_METHODS,
    OFFLINE_TABLES,
    TASK_SETS,
    OfflineRecipe,
    Portion,
)
from lw_torchrl.paper.runs import EVALUATION_SEED, Work, execute_run

import lw_torchrl as lw
from lw_torchrl.data.behaviours import BEHAVIOURS
from lw_torchrl.data.dataset import read_metadata

PLANS = lw.load_plans("MT10")
TINY = OfflineRecipe(steps=6, value_steps=6, batch_size=10, width=16, depth=1, critic_depth=1)
STEPS = 120  # of an episode: a few wrong skills open a drawer in so many


def tiny(method="advantage", actor="pcbc", critic="pcbc", seed=0, recipe=TINY):
    return OfflineRun("two", "W", seed, recipe, STEPS, method, actor, critic, episodes=1)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with the data of seed 0."""
    out = tmp_path_factory.mktemp("offline")
    for dataset in tiny().datasets:
        dataset.collect(out, progress=False)
    return out


@pytest.fixture
def out(made, tmp_path):
    """A folder of its own with the same data."""
    shutil.copytree(made / "data", tmp_path / "data")
    return tmp_path


# ---- what they are


def all_runs(seeds=(0, 1, 2)):
    return [
        run
        for name, table in OFFLINE_TABLES.items()
        if name != "quick"
        for run in offline_runs(table, seeds, OfflineRecipe(), 20)
    ]


def test_different_runs_have_different_folders_and_descriptions():
    runs = set(all_runs())
    assert len({run.folder for run in runs}) == len(runs)
    assert len({json.dumps(run.describe(PLANS), sort_keys=True) for run in runs}) == len(runs)
    advantages = {run.advantages for run in runs} - {None}
    assert len({one.folder for one in advantages}) == len(advantages)
    assert len({json.dumps(one.describe(PLANS), sort_keys=True) for one in advantages}) == len(advantages)


def test_the_tables_compare_the_same_steps_and_the_methods_that_they_name():
    for table in OFFLINE_TABLES.values():
        for rows in table.rows.values():
            assert rows[0] == ("advantage", "pcbc", "pcbc")
            assert len(set(rows)) == len(rows)
            assert ("filtered-bc", "pcbc", "pcbc") in rows
    assert {row[0] for row in OFFLINE_TABLES["methods"].rows["B"]} == set(OFFLINE_METHODS)
    assert {method.loss for method in OFFLINE_METHODS.values()} == set(DISTRIBUTIONS)


def test_no_two_datasets_begin_alike_and_none_as_an_evaluation(monkeypatch, tmp_path):
    seeds = {}
    monkeypatch.setattr(
        "lw_torchrl.paper.runs.collect_demonstrations",
        lambda tasks, *, seed, policy, **_: seeds.setdefault(seed, []).append(policy),
    )
    for seed in (0, 1, 99):
        for behaviour in BEHAVIOURS:
            BehaviourDataset("five", Portion(behaviour, 1), seed).collect(tmp_path, progress=False)
    assert len(seeds) == 3 * len(BEHAVIOURS)
    assert max(seeds) < EVALUATION_SEED


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(tasks="fife"), "tasks must be one of .*did you mean 'five'"),
        (dict(mixture="D"), "mixture must be one of 'B', 'W', 'C', got 'D'"),
        (dict(seed=100), "seed must be from 0 to 99, got 100"),
        (dict(method="awr"), "method must be one of 'advantage'"),
        (dict(critic="plan"), "critic must be one of 'pcbc', 'dc', 'one-hot', got 'plan'"),
    ],
)
def test_wrong_runs_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        OfflineRun(**{"tasks": "five", "mixture": "B", "seed": 0, **options})


def test_mixtures_share_their_datasets():
    folders = {name: {d.folder for d in OfflineRun("five", name, 0).datasets} for name in MIXTURES}
    assert folders["W"] < folders["B"]
    assert len(folders["C"] & folders["W"]) == 2
    assert not folders["W"] & {d.folder for d in OfflineRun("five", "W", 1).datasets}


def test_data_are_of_the_behaviours_that_mixtures_name(made):
    found = {dataset.portion: read_metadata(made / dataset.folder) for dataset in tiny().datasets}
    for portion, described in found.items():
        assert described.config.behaviour == portion.behaviour
        assert described.config.tasks == TASK_SETS["two"]
        assert described.config.episodes_per_task == portion.episodes


# ---- what they do


@pytest.mark.parametrize("method", OFFLINE_METHODS)
@pytest.mark.parametrize(("actor", "critic"), [("pcbc", "pcbc"), pytest.param("dc", "one-hot", marks=pytest.mark.slow)])
def test_every_method_learns_and_is_evaluated(made, method, actor, critic):
    run = tiny(method, actor, critic)
    result = execute_run(run, PLANS, made, progress=False)
    assert set(result.success_once) == set(TASK_SETS["two"])
    assert result.config["seed"] == EVALUATION_SEED
    policy = lw.load_actor(made / run.folder / "policy.zip")
    assert policy.tasks == TASK_SETS["two"]
    assert not (made / run.folder / "checkpoint.zip").exists()
    again = execute_run(run, PLANS, made, progress=False)
    assert (again.episodes, again.config["run"]) == (result.episodes, result.config["run"])


def test_advantages_are_those_of_the_value_standardised_by_task(out):
    one = tiny().advantages
    found = one.make(PLANS, out, progress=False)["advantage"]
    replay = lw.LanguageWorldExperienceReplay(
        [out / d.folder for d in one.datasets], label="executed", terminate_on_success=True
    )
    task = replay[:]["task_id"]
    assert found.shape == (len(replay), 1)
    for number in task.unique():
        own = found[task == number].double()
        assert abs(own.mean().item()) < 1e-4
        assert abs(own.std(correction=0).item() - 1) < 1e-3
    assert torch.equal(one.make(PLANS, out, progress=False)["advantage"], found)


def test_stopped_anywhere_a_run_ends_with_the_same_policy(made, out, monkeypatch):
    run = tiny()
    expected = execute_run(run, PLANS, made, progress=False)
    trainer = "lw_torchrl.training.offline.OfflineTrainer.step"
    real = lw.OfflineTrainer.step
    for stop in (4, 9):  # in the value's training, and in the policy's
        left = [stop if stop < TINY.value_steps else stop - 4]

        def step(self, left=left):
            if not left[0]:
                raise KeyboardInterrupt
            left[0] -= 1
            return real(self)

        monkeypatch.setattr(trainer, step)
        with pytest.raises(KeyboardInterrupt):
            execute_run(run, PLANS, out, progress=False)
    monkeypatch.setattr(trainer, real)
    found = execute_run(run, PLANS, out, progress=False)
    assert found.success_once == expected.success_once
    ours, theirs = (lw.load_actor(root / run.folder / "policy.zip").state_dict() for root in (out, made))
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)


def test_results_and_advantages_of_another_recipe_are_refused(made):
    execute_run(tiny(), PLANS, made, progress=False)
    other = replace(TINY, beta=1.5)
    with pytest.raises(ValueError, match=r"results.json' is of another configuration, it differs in recipe.beta"):
        execute_run(tiny(recipe=other), PLANS, made, progress=False)
    with pytest.raises(ValueError, match=r"its run differs in recipe.beta"):
        tiny(recipe=other).advantages.make(PLANS, made, progress=False)
    with pytest.raises(ValueError, match=r"its run differs in recipe.beta"):
        tiny(recipe=other).learn(Work(PLANS, made, progress=False))


def test_what_a_method_gave_before_it_was_changed_is_refused(out, monkeypatch):
    run = tiny("bc")
    execute_run(run, PLANS, out, progress=False)
    changed = replace(OFFLINE_METHODS["bc"], version=2)
    monkeypatch.setattr("lw_torchrl.paper.recipes.OFFLINE_METHODS", {**OFFLINE_METHODS, "bc": changed})
    with pytest.raises(ValueError, match=r"it differs in how.version"):
        execute_run(run, PLANS, out, progress=False)


def test_a_run_that_another_process_ends_first_is_the_same(out, monkeypatch):
    run = tiny("bc")
    kept = "lw_torchrl.paper.runs.save_actor"
    monkeypatch.setattr(
        kept, lambda *one, **about: (lw.save_actor(*one, **about), (out / run.folder / "checkpoint.zip").unlink())
    )
    assert execute_run(run, PLANS, out, progress=False).config["run"] == run.describe(PLANS)


def test_damaged_advantages_are_refused(made, out):
    one = tiny().advantages
    one.make(PLANS, out, progress=False)
    file = out / one.folder / "advantages.zip"
    file.write_bytes(file.read_bytes()[:-40])
    with pytest.raises(ValueError, match=r"advantages.zip. is damaged .*delete it to learn them again"):
        one.make(PLANS, out, progress=False)


def test_a_critic_that_does_not_see_the_plan_is_made_of_the_number_alone(made):
    ways = [tiny(critic=critic).advantages for critic in ("pcbc", "dc", "one-hot")]
    found = [one.make(PLANS, made, progress=False)["advantage"] for one in ways]
    for one, two in pairwise(found):
        assert not torch.equal(one, two)


def test_the_table_says_means_intervals_and_differences(made):
    runs = [tiny(), tiny("filtered-bc"), tiny("bc", "dc")]
    results = {run: execute_run(run, PLANS, made, progress=False) for run in runs}
    head = write_table("quick", runs, results, made)
    for run in runs:
        assert f"{run.label} " in head
        assert f"{results[run].mean_success:.3f}" in head
    text = (made / "quick.md").read_text()
    assert "20 spoilt-30, 20 wrong, 10 random" in text
    assert "advantage, plan - filtered-bc, plan:" in text
    told = json.loads((made / "quick.json").read_text())
    assert set(told["W"]["methods"]) == {run.label for run in runs}
    assert (made / "quick.png").stat().st_size > 10_000


def test_descriptions_tell_what_a_result_hangs_on():
    run = OfflineRun("five", "B", 0)
    described = run.describe(PLANS)
    changes = [
        replace(run, method="iql"),
        replace(run, actor="dc"),
        replace(run, critic="dc"),
        replace(run, seed=1),
        replace(run, recipe=replace(run.recipe, gamma=0.98)),
        replace(run, max_steps=400),
    ]
    for changed in changes:
        assert changed.describe(PLANS) != run.describe(PLANS)
    assert replace(run, episodes=3).describe(PLANS) == run.describe(PLANS)
    cloned = replace(run, method="bc")
    assert replace(cloned, critic="dc").describe(PLANS) == cloned.describe(PLANS)
    noise = {**NOISE, "wrong": {"noise_scale": 0.1}}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lw_torchrl.paper.recipes.NOISE", noise)
        assert run.describe(PLANS) != described
    assert described["data"][0] == {"behaviour": "spoilt-30", "episodes": 20, **NOISE["spoilt-30"]}
    assert isinstance(Advantages("five", "B", 0).describe(PLANS)["recipe"], dict)
