"""Imitation that trains an evaluator: what holds it to the words, and where it left them."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from small_training import CONFIG, PLANS, Stopping, assert_same, collect_demos, everything, make_actor
from tensordict.nn import TensorDictSequential

import lw_torchrl as lw


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return collect_demos(tmp_path_factory.mktemp("demos") / "demos")


def tuned(root, weight, steps=12, path=None, stop_at=None):
    torch.manual_seed(0)
    evaluator = lw.StateQueryEvaluator(PLANS, width=16, depth=1)
    actor = TensorDictSequential(evaluator, make_actor())
    replay = lw.LanguageWorldExperienceReplay(root, sampler=lw.TaskBalancedSampler())
    config = replace(CONFIG, qaf_anchor=weight, steps=steps)
    trainer = Stopping(actor, replay, config, checkpoint=path, progress=False)
    trainer.stop_at = stop_at
    return trainer


def agreement(trainer):
    rows = trainer.replay[:]
    exact = lw.QAFTransform(PLANS)(rows.select("observation", "task_id"))["qaf"]
    with torch.no_grad():
        return ((trainer.actor[0].logits_of(rows) > 0) == exact).float().mean()


def test_the_anchor_holds_conditions_to_their_words(root):
    free, held = tuned(root, 0.0, 60), tuned(root, 1.0, 60)
    before = agreement(free)
    for trainer in (free, held):
        trainer.train()
    assert agreement(held) > max(before, agreement(free)) + 0.1
    assert agreement(held) > 0.9


def test_training_moves_the_evaluator_and_goes_on_to_the_bit(root, tmp_path):
    whole = tuned(root, 0.5)
    start = {name: one.detach().clone() for name, one in whole.actor[0].named_parameters()}
    whole.train()
    assert not torch.equal(start["network.trunk.0.weight"], whole.actor[0].network.trunk[0].weight)
    with pytest.raises(KeyboardInterrupt):
        tuned(root, 0.5, path=tmp_path / "p.safetensors", stop_at=7).train()
    again = tuned(root, 0.5, path=tmp_path / "p.safetensors")
    assert again.steps == 5
    again.train()
    assert_same(everything(again), everything(whole))
    loaded = lw.load_actor(tmp_path / "p.safetensors")
    rows = whole.replay[:].select("observation", "task_id")
    assert torch.equal(loaded(rows.clone())["action"], whole.actor.eval()(rows.clone())["action"])


def test_what_has_no_evaluator_is_refused(root):
    replay = lw.LanguageWorldExperienceReplay(root, transform=lw.QAFTransform(PLANS))
    with pytest.raises(
        ValueError, match=r"qaf_anchor needs a policy with one learned evaluator.* this PlanConditionedActor has none"
    ):
        lw.BehavioralCloningTrainer(make_actor(), replay, replace(CONFIG, qaf_anchor=1.0))
