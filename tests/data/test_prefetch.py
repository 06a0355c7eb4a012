"""Batches drawn ahead are those that are drawn when they are asked for."""

from __future__ import annotations

import pytest
import torch
from collecting import collect

import lw_torchrl as lw

SAMPLERS = {"balanced": lw.TaskBalancedSampler, "co-learning": lambda: lw.CoLearningSampler("push")}


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    root = tmp_path_factory.mktemp("demos") / "d"
    collect(root)
    return root


def make(demos, sampler, prefetch):
    return lw.LanguageWorldExperienceReplay(
        demos,
        sampler=SAMPLERS[sampler](),
        transform=lw.QAFTransform(lw.load_plans("MT10")),
        batch_size=8,
        prefetch=prefetch,
        generator=torch.Generator().manual_seed(0),
    )


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_one_batch_ahead_is_the_same_batch(demos, sampler):
    ahead, now = make(demos, sampler, 1), make(demos, sampler, None)
    for _ in range(40):
        assert (ahead.sample() == now.sample()).all()
    assert ahead._prefetch_queue


def test_several_ahead_would_come_in_any_order(demos):
    with pytest.raises(ValueError, match="prefetch must be None, 0 or 1, got 3: several threads draw"):
        make(demos, "balanced", 3)
