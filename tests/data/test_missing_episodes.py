"""Which episodes a dataset holds: neither the environments, nor the tasks beside, nor interruptions change it."""

from __future__ import annotations

import pytest
import torch
from collecting import collect, interrupt_after, tree

from lw_torchrl.data.dataset import load_rows
from lw_torchrl.language.tasks import MT50


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return collect(tmp_path_factory.mktemp("made") / "demos")


@pytest.fixture(scope="module")
def rows(made):
    return load_rows(made)


# ---- it does not depend on


@pytest.mark.parametrize("num_envs", [2, 5, 9])
def test_the_number_of_environments_changes_nothing(made, tmp_path, num_envs):
    collect(tmp_path / "demos", num_envs=num_envs)
    assert tree(tmp_path / "demos") == tree(made.root)


def test_a_tasks_rows_do_not_depend_on_the_tasks_beside_it(rows, tmp_path):
    alone = load_rows(collect(tmp_path / "demos", "reach")).exclude("collector")
    beside = rows[rows["task_id"] == MT50.index("reach")].exclude("collector")
    assert (alone == beside).all()


# ---- redrawing failures

REDRAW = dict(tasks="reach", episodes_per_task=3, max_steps=50, noise_scale=(0.4,))


@pytest.fixture(scope="module")
def redrawn(tmp_path_factory):
    return collect(tmp_path_factory.mktemp("redrawn") / "demos", redraw_failures=True, **REDRAW)


def test_redrawing_keeps_the_first_successes_and_only_them(redrawn, tmp_path):
    attempts = redrawn.attempts["reach"]
    everything = collect(tmp_path / "demos", **{**REDRAW, "episodes_per_task": attempts})
    good = [e.episode for e in everything.episodes if e.success]
    assert len(good) < attempts, "the test wants a failure among the episodes"
    assert [e.episode for e in redrawn.episodes] == good
    assert redrawn.success_rate == {"reach": 1.0}
    all_rows, kept = load_rows(everything), load_rows(redrawn)
    same = all_rows[torch.isin(all_rows["episode"], torch.tensor(good))].exclude("collector")
    assert (kept.exclude("collector") == same).all()


@pytest.mark.parametrize("num_envs", [1, 4])
def test_redrawing_is_the_same_with_any_number_of_environments(redrawn, tmp_path, num_envs):
    collect(tmp_path / "demos", redraw_failures=True, num_envs=num_envs, **REDRAW)
    assert tree(tmp_path / "demos") == tree(redrawn.root)


def test_redrawing_carries_on_after_an_interruption(redrawn, tmp_path, monkeypatch):
    interrupt_after(monkeypatch, 2)
    with pytest.raises(KeyboardInterrupt):
        collect(tmp_path / "demos", redraw_failures=True, num_envs=1, **REDRAW)
    monkeypatch.undo()
    collect(tmp_path / "demos", redraw_failures=True, **REDRAW)
    assert tree(tmp_path / "demos") == tree(redrawn.root)


def test_redrawing_gives_up_where_nothing_succeeds(tmp_path):
    with pytest.raises(RuntimeError, match=r"'reach'.*0 of 20 .*noise_scale"):
        collect(tmp_path / "demos", "reach", episodes_per_task=1, max_steps=1, redraw_failures=True)
