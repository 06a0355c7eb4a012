"""Sequences of parts: renamed keys, shared modules; truth of other plans than an actor's, which is refused."""

import pytest
import torch
from small_actors import letters
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn

import lw_torchrl as lw
from lw_torchrl.language.relations import RELATIONS, Comparison
from lw_torchrl.modules import (
    ActorEnsemble,
    Concat,
    FocusFeatures,
    PlanAttention,
    SkillMixer,
    Value,
    plan_trunk,
    transform_of,
)

PLANS = lw.load_plans("MT10")
REVERSED = lw.Plans([lw.ConditionalPlan(plan.task, plan.steps[::-1], plan.definition) for plan in PLANS.values()])
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


PLACE = ("the gripper is not above the puck", "place the gripper above the puck")
LOWER = ("the gripper is above the puck", "lower the gripper around the puck")
REFUSED = "qaf was computed with plans.* push"


def push_plans(pairs, *more):
    return lw.Plans([lw.ConditionalPlan.from_pairs("push", pairs), *more])


PUSH = push_plans([PLACE, LOWER])
OTHERS = {
    "steps in another order": push_plans([LOWER, PLACE]),
    "another condition": push_plans([(f"{PLACE[0]} and the gripper is open", PLACE[1]), LOWER]),
    "another skill": push_plans([PLACE, (LOWER[0], "close the gripper around the puck")]),
}
ACTORS = {
    "actor": lambda plans, **keys: lw.PlanConditionedActor(plans, **keys),
    "focus": lambda plans, **keys: lw.PlanConditionedActor(plans, features=FocusFeatures(plans), **keys),
    "scripted": lw.ScriptedSkillActor,
    "ensemble": lambda plans, **keys: ActorEnsemble([lw.PlanConditionedActor(plans, **keys)] * 2),
    "attention": lambda plans: PlanAttention(plans),
}


def rows_of(plans):
    data = TensorDict(observation=torch.zeros(3, 39), task_id=torch.full((3,), lw.task_id("push")))
    return lw.QAFTransform(plans)(data.auto_batch_size_())


@pytest.mark.parametrize("other", OTHERS)
@pytest.mark.parametrize("make", ACTORS)
def test_actor_refuses_truth_of_other_plans(make, other):
    actor = ACTORS[make](PUSH)
    with pytest.raises(ValueError, match=REFUSED):
        actor(rows_of(OTHERS[other]))
    assert actor(rows_of(OTHERS[other]).exclude("qaf_plan"))["skill_weights"].shape == (3, 2)
    assert actor(rows_of(push_plans([PLACE, LOWER])))["skill_weights"].shape == (3, 2), "equal plans"


def test_each_row_carries_the_number_of_its_plan():
    reach = lw.ConditionalPlan.from_pairs("reach", [("the gripper is open", "close the gripper")] * 2)
    both = push_plans([PLACE, LOWER], reach)
    mixed = TensorDict(observation=torch.zeros(4, 39), task_id=IDS.repeat(2))
    mixed = lw.QAFTransform(both)(mixed.auto_batch_size_())
    assert mixed["qaf_plan"].tolist() == [both.numbers["push"], both.numbers["reach"]] * 2
    assert mixed["qaf_plan"][0] == rows_of(PUSH)["qaf_plan"][0], "whatever stands beside it"
    lw.PlanConditionedActor(both)(mixed)
    other = lw.ConditionalPlan.from_pairs("reach", [("the gripper is closed", "close the gripper")] * 2)
    with pytest.raises(ValueError, match="for reach; pass"):
        lw.PlanConditionedActor(push_plans([PLACE, LOWER], other))(mixed)


def test_refusal_after_a_relation_was_redefined(monkeypatch):
    before = lw.PlanConditionedActor(PUSH)
    monkeypatch.setitem(RELATIONS, "above", (Comparison("z", ">", 0.3),))
    with pytest.raises(ValueError, match=REFUSED):
        before(rows_of(PUSH))
    lw.PlanConditionedActor(PUSH)(rows_of(PUSH))


def test_vmap_over_rows_skips_the_check_and_over_weights_keeps_it():
    actor, data = lw.PlanConditionedActor(PUSH).eval(), rows_of(OTHERS["another skill"])
    assert torch.vmap(lambda row: actor(row)["action"])(data.exclude("action")).shape == (3, 4)
    params = TensorDict.from_module(actor).expand(2).clone()

    def act(params):
        with params.to_module(actor):
            return actor(data.copy())["action"]

    with pytest.raises(ValueError, match=REFUSED):  # over weights the numbers can be read
        torch.vmap(act)(params)


def test_compiled_actor_refuses_at_run_time():
    actor = lw.PlanConditionedActor(PUSH).eval()
    act = torch.compile(lambda data: actor(data)["action"], backend="eager")
    assert act(rows_of(PUSH)).shape == (3, 4)
    with pytest.raises(RuntimeError, match="qaf was computed with plans"):
        act(rows_of(OTHERS["another skill"]))
    wrong = rows_of(PUSH)
    wrong["observation"][1, 2] = torch.nan
    with pytest.raises(RuntimeError, match="finite numbers"):
        act(wrong)


def test_a_part_must_write_what_the_next_ones_read():
    actor = lw.PlanConditionedActor(PLANS)
    with pytest.raises(ValueError, match=r"features must write .*, which later parts read"):
        actor.features = TensorDictModule(nn.Linear(39, 56), ["observation"], ["seen"])
    with pytest.raises(ValueError, match="trunk must have at least two named parts"):
        Value(TensorDictSequential(PlanAttention(PLANS), SkillMixer(PLANS)))
