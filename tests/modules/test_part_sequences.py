"""Sequences of parts: renamed keys, the plans of all parts, and modules that are shared."""

import pytest
import torch
from small_actors import letters
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn

import lw_torchrl as lw
from lw_torchrl.modules import (
    ActorEnsemble,
    Concat,
    FocusFeatures,
    SkillMixer,
    Value,
    plan_trunk,
    transform_of,
)

PLANS = lw.load_plans("MT10")
REVERSED = lw.Plans(
    [lw.ConditionalPlan(plan.task, tuple(reversed(plan.steps)), plan.definition) for plan in PLANS.values()]
)
IDS = torch.tensor([lw.task_id("push"), lw.task_id("reach")])


def inputs(qaf=None):
    truth = torch.zeros(2, PLANS.num_steps) if qaf is None else qaf
    return {"qaf": truth, "task_id": IDS, "observation": torch.linspace(0, 1, 78).reshape(2, 39)}


def two_keys():
    scaled = TensorDictModule(nn.LayerNorm(39), ["observation"], ["scaled"])
    return TensorDictSequential(scaled, TensorDictModule(nn.Linear(39, 16), ["scaled"], ["features"]))


def test_features_may_write_more_than_one_key():
    actor = lw.PlanConditionedActor(PLANS, features=two_keys())
    assert actor.decoder.in_keys == ["skill_latent", "features"]
    true = torch.zeros(2, PLANS.num_steps)
    true[:, 1] = 1.0
    assert not torch.equal(actor(**inputs())[-1], actor(**inputs(true))[-1])
    value = Value(plan_trunk(PLANS, features=two_keys()))
    assert not torch.equal(value(**inputs()), value(**inputs(true)))
    assert Concat(two_keys()).eval()(observation=torch.zeros(2, 39)).shape == (2, 16)


def test_parts_with_different_plans_are_refused():
    with pytest.raises(ValueError, match="attention and features"):
        lw.PlanConditionedActor(PLANS, features=FocusFeatures(REVERSED))
    actor = lw.PlanConditionedActor(PLANS)
    with pytest.raises(ValueError, match="attention and mixer"):
        actor.mixer = SkillMixer(REVERSED)
    policy = TensorDictSequential(lw.modules.StateQueryEvaluator(REVERSED), lw.PlanConditionedActor(PLANS))
    with pytest.raises(ValueError, match="qaf was computed with plans"):
        policy(observation=torch.zeros(2, 39), task_id=IDS)


def test_evaluator_replaces_the_answers_of_an_environment_with_other_plans():
    canonical = lw.canonical_plans(PLANS)
    policy = TensorDictSequential(lw.modules.StateQueryEvaluator(canonical), lw.PlanConditionedActor(canonical))
    rows = lw.QAFTransform(PLANS)(lw.LanguageWorldEnv(["push", "reach"]).reset())
    assert policy(rows)["action"].shape == (2, 4)


def test_transform_writes_a_renamed_turn():
    plans = lw.canonical_plans(PLANS, fallback=True)
    actor = lw.PlanConditionedActor(plans, in_keys=["qaf", "task_id", "my_turn", "observation"])
    assert "my_turn" in transform_of(actor)[1].out_keys
    assert actor.with_plans(plans).in_keys == actor.in_keys


def test_renamed_keys_of_an_ensemble_skip_what_a_member_writes_itself():
    member = TensorDictSequential(lw.modules.StateQueryEvaluator(PLANS), lw.PlanConditionedActor(PLANS))
    ensemble = ActorEnsemble([member, lw.PlanConditionedActor(PLANS)])
    ensemble.in_keys = ["truth" if key == "qaf" else key for key in ensemble.in_keys]
    assert [actor.in_keys[0] for actor in (ensemble.members[0][1], ensemble.members[1])] == ["qaf", "truth"]


def test_with_plans_keeps_dtype_modes_statistics_and_text_encoder():
    actor = lw.PlanConditionedActor(PLANS, text_encoder=letters).double().train()
    actor.decoder.eval()
    other = actor.with_plans(REVERSED)
    assert (other.training, actor.decoder.training, other.mixer.text_encoder) == (True, False, letters)
    other.features.fit(TensorDict(observation=torch.rand(50, 39), batch_size=[50]))
    assert torch.equal(other.features.mean, actor.features.mean)
    observation = torch.zeros(2, 39, dtype=torch.float64)
    assert other(**{**inputs(), "observation": observation})[-1].dtype == torch.float64


def test_features_in_a_sequence_follow_other_plans():
    features = TensorDictSequential(FocusFeatures(PLANS))
    other = lw.PlanConditionedActor(PLANS, features=features).with_plans(REVERSED)
    assert other.features[0].plans == REVERSED
    lost = TensorDictModule(nn.Linear(39, 16), ["observation"], ["features"])
    lost.plans = PLANS
    with pytest.raises(TypeError, match="TensorDictModule"):
        lw.PlanConditionedActor(PLANS, features=lost).with_plans(REVERSED)
