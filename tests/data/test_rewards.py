"""Rewards by name, each computed again by hand."""

from __future__ import annotations

import pytest
import torch
from collecting import collect

import lw_torchrl as lw
from lw_torchrl.data.dataset import load_rows
from lw_torchrl.data.rewards import REWARDS


def by_hand(name, dense, success):
    if name == "sparse":
        return 1.0 if success else 0.0
    if name == "dense":
        return dense
    if success:
        return 0.0
    return -0.01 if name == "cost" else (dense - 10.0) / 100.0


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Successes and failures of reach, by plans with scripted skills, dense rewards of 0 to 10."""
    made = collect(
        tmp_path_factory.mktemp("rewards") / "demos",
        tasks="reach",
        policy="scripted",
        noise_scale=0.0,
        max_steps=34,
        episodes_per_task=5,
    )
    assert {e.success for e in made.episodes} == {True, False}
    return made


@pytest.mark.parametrize("name", list(REWARDS))
@pytest.mark.parametrize("ends", [dict(), dict(after_success=2), dict(terminate_on_success=True)])
def test_each_row_has_the_reward_named(made, name, ends):
    rows = load_rows(made)
    replay = lw.LanguageWorldExperienceReplay(made.root, label="executed", reward=name, **ends)
    found = replay[:]
    kept = [
        info.start + step
        for info in made.episodes
        for step in range(info.length)
        if not ends or not info.success or step < info.first_success + ends.get("after_success", 0)
    ]
    assert len(found) == len(kept)
    for row, source in enumerate(kept):
        dense, success = float(rows["next", "reward_dense"][source]), bool(rows["next", "success"][source])
        assert float(found["next", "reward"][row]) == pytest.approx(by_hand(name, dense, success), abs=1e-6)
    assert found["next", "reward"].dtype == torch.float32
    assert found["next", "reward"].shape == (len(kept), 1)


@pytest.mark.parametrize(("name", "least", "most"), [("cost", -0.01, 0.0), ("dense_cost", -0.1001, 0.0)])
def test_costs_end_at_nought_where_episodes_end_at_success(made, name, least, most):
    replay = lw.LanguageWorldExperienceReplay(made.root, label="executed", reward=name, terminate_on_success=True)
    rows = replay[:]
    reward, terminated = rows["next", "reward"], rows["next", "terminated"]
    assert terminated.any()
    assert (reward[terminated] == 0).all()
    assert (reward[~terminated] < 0).all()
    assert reward.min() >= least
    assert reward.max() <= most
