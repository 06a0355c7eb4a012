"""Actors and buffers that do not belong together are refused before they train."""

from __future__ import annotations

import pytest

from lw_torchrl.data import LanguageWorldExperienceReplay, TaskBalancedSampler, collect_demonstrations
from lw_torchrl.language.plan_files import load_plans
from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.modules import PlanConditionedActor
from lw_torchrl.training import BehavioralCloningConfig, BehavioralCloningTrainer
from lw_torchrl.transforms import QAFTransform

CONFIG = BehavioralCloningConfig(steps=3, batch_size=8)
PLANS = load_plans("MT10")


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    root = tmp_path_factory.mktemp("belonging") / "demos"
    collect_demonstrations("reach", episodes_per_task=1, root=root, max_steps=15, progress=False)
    return root


def test_other_plans_of_the_same_length_are_refused(demos):
    """Nobody would notice: the answers have the right shape, and are those of other conditions."""
    told = [(str(step.condition), step.skill) for step in PLANS["reach"].steps]
    turned = [(condition, skill) for (condition, _), (_, skill) in zip(told, told[1:] + told[:1], strict=True)]
    turned = [(told[-1][0], told[0][1]), *told[1:-1], (told[0][0], told[-1][1])]
    kept = [plan for task, plan in PLANS.items() if task != "reach"]
    other = Plans([*kept, ConditionalPlan.from_pairs("reach", turned)])
    assert other.num_steps == PLANS.num_steps
    replay = LanguageWorldExperienceReplay(demos, sampler=TaskBalancedSampler(), transform=QAFTransform(other))
    message = (
        r"replay's QAFTransform must have the actor's plans, they differ for reach; use QAFTransform\(actor.plans\)"
    )
    actor = PlanConditionedActor(PLANS)
    with pytest.raises(ValueError, match=message):
        BehavioralCloningTrainer(actor, replay, CONFIG)


def test_an_actor_that_writes_no_action_is_named(demos):
    actor = PlanConditionedActor(PLANS, out_keys=["wish"])
    with pytest.raises(ValueError, match=r"actor must write 'action', it writes skill_weights, skill_latent, .*wish"):
        BehavioralCloningTrainer(actor, LanguageWorldExperienceReplay(demos), CONFIG)


def test_rows_without_answers_are_named(demos):
    replay = LanguageWorldExperienceReplay(demos, sampler=TaskBalancedSampler())
    trainer = BehavioralCloningTrainer(PlanConditionedActor(PLANS), replay, CONFIG, progress=False)
    with pytest.raises(ValueError, match=r"needed, got .*; without qaf: QAFTransform\(plans\)"):
        trainer.train()


def test_a_buffer_for_minibatches_of_another_size_is_refused(demos):
    replay = LanguageWorldExperienceReplay(demos, batch_size=16, transform=QAFTransform(PLANS))
    actor = PlanConditionedActor(PLANS)
    message = "batch_size of the replay buffer must be None or .* 8, got 16"
    with pytest.raises(ValueError, match=message):
        BehavioralCloningTrainer(actor, replay, CONFIG)
    same = LanguageWorldExperienceReplay(demos, batch_size=8, transform=QAFTransform(PLANS))
    BehavioralCloningTrainer(actor, same, CONFIG, progress=False).train()
