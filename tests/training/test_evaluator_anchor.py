"""Imitation that trains an evaluator: what holds it to the words, and where it left them."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from small_training import CONFIG, PLANS, SMALL, Stopping, assert_same, collect_demos, everything, make_actor

import lw_torchrl as lw
from lw_torchrl.evaluation import condition_drift, drift_table


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return collect_demos(tmp_path_factory.mktemp("demos") / "demos")


def tuned(root, weight, steps=12, path=None, stop_at=None):
    torch.manual_seed(0)
    evaluator = lw.StateQueryEvaluator(PLANS, width=16, depth=1)
    actor = lw.PlanConditionedActor(PLANS, evaluator=evaluator, answers="tanh", **SMALL)
    replay = lw.LanguageWorldExperienceReplay(root, sampler=lw.TaskBalancedSampler())
    config = replace(CONFIG, qaf_anchor=weight, steps=steps)
    trainer = Stopping(actor, replay, config, checkpoint=path, progress=False)
    trainer.stop_at = stop_at
    return trainer


def agreement(trainer):
    found = condition_drift(trainer.actor, trainer.replay[:])
    return sum(one.agreement for one in found) / len(found)


def test_the_anchor_holds_conditions_to_their_words(root):
    free, held = tuned(root, 0.0, 60), tuned(root, 1.0, 60)
    before = agreement(free)
    for trainer in (free, held):
        trainer.train()
    assert agreement(held) > max(before, agreement(free)) + 0.1
    assert agreement(held) > 0.9


def test_training_moves_the_evaluator_and_goes_on_to_the_bit(root, tmp_path):
    whole = tuned(root, 0.5)
    start = {name: one.detach().clone() for name, one in whole.actor.evaluator.named_parameters()}
    whole.train()
    assert not torch.equal(start["network.trunk.0.weight"], whole.actor.evaluator.network.trunk[0].weight)
    with pytest.raises(KeyboardInterrupt):
        tuned(root, 0.5, path=tmp_path / "p.zip", stop_at=7).train()
    again = tuned(root, 0.5, path=tmp_path / "p.zip")
    assert again.steps == 5
    again.train()
    assert_same(everything(again), everything(whole))
    loaded = lw.load_actor(tmp_path / "p.zip")
    rows = whole.replay[:].select("observation", "task_id")
    assert torch.equal(loaded(rows.clone())["action"], whole.actor.eval()(rows.clone())["action"])


def test_a_drift_says_what_a_condition_came_to_mean(root):
    class Never(lw.QueryEvaluator):
        def logits(self, observation, task_id):
            return torch.full((*task_id.shape, self.plans.num_steps), -1.0)

    rows = lw.LanguageWorldExperienceReplay(root)[:]
    found = condition_drift(lw.ScriptedSkillActor(PLANS, evaluator=Never(PLANS)), rows)
    assert {one.task for one in found} == {"push", "reach"}
    assert len(found) == len(PLANS["push"].steps) + len(PLANS["reach"].steps)
    assert [one.agreement for one in found] == sorted(one.agreement for one in found)
    truth = lw.QAFTransform(PLANS)(rows.clone())["qaf"]
    for one in found:
        own = truth[rows["task_id"] == lw.task_id(one.task)][:, one.step]
        assert (one.states, one.believed) == (len(own), 0.0)
        assert one.exact == pytest.approx(own.float().mean().item())
        assert one.agreement == pytest.approx(1.0 - one.exact)
        assert one.condition == str(PLANS[one.task].steps[one.step].condition)
    assert found[0].condition in drift_table(found, most=1)


def test_what_has_no_evaluator_is_refused(root):
    replay = lw.LanguageWorldExperienceReplay(root, transform=lw.QAFTransform(PLANS))
    with pytest.raises(ValueError, match="qaf_anchor is for a policy with an evaluator, this PlanConditionedActor"):
        lw.BehavioralCloningTrainer(make_actor(), replay, replace(CONFIG, qaf_anchor=1.0))
    with pytest.raises(ValueError, match="qaf_anchor is for BehavioralCloningTrainer"):
        lw.training.StackedBehavioralCloning([make_actor()], [replay], replace(CONFIG, qaf_anchor=1.0))
    with pytest.raises(ValueError, match="policy must have an evaluator"):
        condition_drift(make_actor(), replay[:])
