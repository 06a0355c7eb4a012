"""Imitation that also trains an evaluator: the anchor keeps its answers close to the exact ones."""

from dataclasses import replace

import pytest
import torch
from small_training import CONFIG, PLANS, Stopping, assert_same, everything, make_actor
from tensordict.nn import TensorDictSequential

import lw_torchrl as lw


def make_trainer(demos, weight, steps=12, path=None, stop_at=None):
    torch.manual_seed(0)
    evaluator = lw.modules.StateQueryEvaluator(PLANS, width=16, depth=1)
    actor = TensorDictSequential(evaluator, make_actor())
    replay = lw.LanguageWorldExperienceReplay(demos, sampler=lw.TaskBalancedSampler())
    config = replace(CONFIG, qaf_anchor=weight, steps=steps)
    trainer = Stopping(actor, replay, config, checkpoint=path, progress=False)
    trainer.stop_at = stop_at
    return trainer


def agreement(trainer):
    rows = trainer.replay[:]
    exact = lw.QAFTransform(PLANS)(rows.select("observation", "task_id"))["qaf"]
    with torch.no_grad():
        return ((trainer.actor[0].logits_of(rows) > 0) == exact).float().mean()


def test_the_anchor_keeps_the_answers_exact(demos):
    free, anchored = make_trainer(demos, 0.0, 60), make_trainer(demos, 1.0, 60)
    before = agreement(free)
    for trainer in (free, anchored):
        trainer.train()
    assert agreement(anchored) > max(before, agreement(free)) + 0.1
    assert agreement(anchored) > 0.9


def test_training_changes_the_evaluator_and_resumes_bit_for_bit(demos, tmp_path):
    whole = make_trainer(demos, 0.5)
    start = {name: value.detach().clone() for name, value in whole.actor[0].named_parameters()}
    whole.train()
    assert not torch.equal(start["network.trunk.0.weight"], whole.actor[0].network.trunk[0].weight)
    path = tmp_path / "p.safetensors"
    with pytest.raises(KeyboardInterrupt):
        make_trainer(demos, 0.5, path=path, stop_at=7).train()
    resumed = make_trainer(demos, 0.5, path=path)
    assert resumed.steps == 5
    resumed.train()
    assert_same(everything(resumed), everything(whole))
    rows = whole.replay[:].select("observation", "task_id")
    assert torch.equal(lw.load_actor(path)(rows.clone())["action"], whole.actor.eval()(rows.clone())["action"])
