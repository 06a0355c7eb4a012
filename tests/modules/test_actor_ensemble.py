"""An ensemble does the mean of what its members would do."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv

import lw_torchrl as lw
from lw_torchrl.language.plans import PlanStep
from lw_torchrl.training.checkpoint import save_actor

PLANS = lw.load_plans("MT10")


def make_members(number=3, kind="plans"):
    torch.manual_seed(0)
    if kind == "plans":
        kinds = ("differences", "relative", "both")  # what members see may differ
        return [lw.PlanConditionedActor(PLANS, width=16 + n, depth=1, features=kinds[n % 3]) for n in range(number)]
    return [lw.DescriptorConditionedActor("MT10", width=16, depth=1) for _ in range(number)]


def make_state(rows=7):
    ids = torch.tensor([lw.task_id(task) for task in lw.MT10])[torch.arange(rows) % 10]
    return TensorDict(
        {
            "observation": torch.rand(rows, 39),
            "task_id": ids,
            "qaf": torch.rand(rows, PLANS.num_steps) < 0.5,
        },
        [rows],
    )


@pytest.mark.parametrize("kind", ["plans", "descriptions"])
def test_the_action_is_the_members_mean(kind):
    members, state = make_members(kind=kind), make_state()
    ensemble = lw.modules.ActorEnsemble(members).eval()
    found = ensemble(state.clone())
    actions = [member(state.clone())["action"] for member in members]
    assert not torch.allclose(actions[0], actions[1], atol=1e-3)
    torch.testing.assert_close(found["action"], (actions[0] + actions[1] + actions[2]) / 3)
    assert set(found.keys()) == {*state.keys(), *ensemble.out_keys}
    if kind == "plans":
        for member in members:
            assert torch.equal(found["skill_weights"], member(state.clone())["skill_weights"])


def test_one_member_alone_does_what_it_would_do():
    (member,) = make_members(1)
    state = make_state()
    ensemble = lw.modules.ActorEnsemble([member]).eval()
    assert torch.equal(ensemble(state.clone())["action"], member(state.clone())["action"])


def test_with_plans_keeps_the_weights_and_the_mode():
    ensemble = lw.modules.ActorEnsemble(make_members(2)).eval()
    plan = lw.ConditionalPlan("reach", [PlanStep("the robot's gripper is open", "wave")])
    other = ensemble.with_plans({"reach": plan})
    assert not other.training
    assert other.plans["reach"] == plan
    for before, after in zip(ensemble.members, other.members, strict=True):
        assert after.head is before.head
    with pytest.raises(TypeError, match="with_plans is for policies with plans"):
        lw.modules.ActorEnsemble(make_members(2, "descriptions")).with_plans({"reach": plan})


def test_it_acts_in_the_environment():
    ensemble = lw.modules.ActorEnsemble(make_members(2)).eval()
    env = TransformedEnv(lw.LanguageWorldEnv("reach", num_envs=2), lw.QAFTransform(ensemble.plans))
    rollout = env.rollout(3, ensemble)
    assert rollout["action"].shape == (2, 3, 4)
    env.close()


@pytest.mark.parametrize("kind", ["plans", "descriptions"])
def test_saved_and_loaded_it_does_the_same(kind, tmp_path):
    ensemble, state = lw.modules.ActorEnsemble(make_members(kind=kind)).eval(), make_state()
    save_actor(ensemble, tmp_path / "policy.safetensors")
    loaded = lw.load_actor(tmp_path / "policy.safetensors")
    assert torch.equal(loaded(state.clone())["action"], ensemble(state.clone())["action"])
    assert not loaded.training


def test_members_that_do_not_belong_together_are_refused():
    with pytest.raises(ValueError, match="members must be at least one policy"):
        lw.modules.ActorEnsemble([])
    with pytest.raises(ValueError, match="members must have the same plans"):
        lw.modules.ActorEnsemble([*make_members(1), lw.PlanConditionedActor({"reach": PLANS["reach"]})])
    with pytest.raises(ValueError, match="members must have the same plans"):
        lw.modules.ActorEnsemble([*make_members(1), *make_members(1, "descriptions")])
    with pytest.raises(ValueError, match="members must have the same tasks"):
        lw.modules.ActorEnsemble([*make_members(1, "descriptions"), lw.DescriptorConditionedActor("reach")])
