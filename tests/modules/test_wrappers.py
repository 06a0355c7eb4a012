"""Wrappers of any actor: ensembles, a decided gripper, demonstrated tasks, another robot."""

import pytest
import torch
from small_actors import CANONICAL, action_of, make_actor, make_descriptor, make_role_actor, make_rows, rows_for
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

import lw_torchrl as lw
from lw_torchrl import modules as m
from lw_torchrl.language.layout import METAWORLD, Layout, Slot
from lw_torchrl.language.objects import GRIPPER, NamedObject
from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.modules.wrappers import decided
from lw_torchrl.suites import load_suite

PLAIN = TensorDictModule(nn.Linear(39, 4), in_keys=["observation"], out_keys=["action"])


def with_effort(actor, effort):
    """Return the actor with a constant effort."""
    *_, last = (part for part in actor.decoder.modules() if isinstance(part, nn.Linear))
    last.weight.data[3], last.bias.data[3] = 0.0, torch.atanh(torch.tensor(effort))
    return actor.eval()


# ---- ActorEnsemble


@pytest.mark.parametrize("kind", ["plan", "description"])
def test_ensemble_action_is_the_mean_of_its_members(kind):
    make = make_actor if kind == "plan" else make_descriptor
    kinds = ("differences", "relative", "both")
    members = [make(seed=seed, features=m.ObservationFeatures(name)) for seed, name in enumerate(kinds)]
    rows = make_rows(7)
    ensemble = m.ActorEnsemble(members).eval()
    output = ensemble(rows.copy())
    actions = [action_of(member, rows) for member in members]
    assert not torch.allclose(actions[0], actions[1], atol=1e-3)
    torch.testing.assert_close(output["action"], (actions[0] + actions[1] + actions[2]) / 3)
    assert set(output.keys()) == {*rows.keys(), *ensemble.out_keys}
    if kind == "plan":
        assert ensemble.out_keys == ["action", "skill_weights"]
        assert torch.equal(output["skill_weights"], members[0](rows.copy())["skill_weights"])


def test_any_modules_can_be_members():
    ensemble, rows = m.ActorEnsemble([PLAIN, PLAIN]), make_rows(3)
    assert ensemble.in_keys == ["observation"]
    torch.testing.assert_close(action_of(ensemble, rows), action_of(PLAIN, rows))


# ---- DecidedGripper


@pytest.mark.parametrize("make", [make_actor, make_descriptor])
def test_the_gripper_is_decided_only_when_the_policy_acts(make):
    actor, rows = make(features=m.ObservationFeatures()), make_rows(200)
    policy = m.DecidedGripper(actor)
    assert (policy.in_keys, policy.out_keys) == (actor.in_keys, actor.out_keys)
    before, after = action_of(policy.train(), rows), action_of(policy.eval(), rows)
    assert before[:, 3].unique().numel() > 2
    torch.testing.assert_close(after[:, :3], before[:, :3])
    assert after[:, 3].abs().eq(1.0).all()


@pytest.mark.parametrize(("effort", "done"), [(0.29, -1.0), (0.31, 1.0), (-0.9, -1.0), (1e-3, -1.0)])
def test_gripper_closes_above_the_layouts_effort(effort, done):
    policy = m.DecidedGripper(with_effort(make_actor(), effort)).eval()
    assert (action_of(policy, make_rows(10))[:, 3] == done).all()
    assert (action_of(m.DecidedGripper(policy.actor, -1.0).eval(), make_rows(10))[:, 3] == 1.0).all()


@pytest.mark.parametrize(("efforts", "done"), [((0.9, 0.35, -0.9), 1.0), ((0.9, 0.2, 0.2), -1.0)])
def test_majority_of_an_ensemble_decides(efforts, done):
    members = [m.DecidedGripper(with_effort(make_actor(), effort)) for effort in efforts]
    policy = m.DecidedGripper(m.ActorEnsemble(members), 0.0).eval()
    assert (action_of(policy, make_rows(10))[:, 3] == done).all()
    assert action_of(policy.train(), make_rows(10))[:, 3].abs().max() < 1


SEVEN = Layout(
    "seven", 16, hand=1, opening=0, things=(Slot(4),), goal=13, action_size=7, displacement=1, gripper=6, closes=-1
)
PUCK = lw.Task("seven/push", "Push it.", (NamedObject(GRIPPER, (1, 2, 3)), NamedObject("puck", (4, 5, 6))), SEVEN)


def seven_plans():
    lower = ("the gripper is above the puck", "lower the gripper around the puck")
    pairs = [lower, ("the gripper is near the puck", "close the gripper around the puck")]
    return lw.canonical_plans(Plans([ConditionalPlan.from_pairs(PUCK, pairs)]))


@pytest.mark.parametrize(("effort", "done"), [(0.2, 1.0), (0.4, -1.0), (-0.2, 1.0)])
@pytest.mark.parametrize("members", [1, 3])
def test_gripper_of_another_robot_is_decided_by_the_first_robots_effort(effort, done, members):
    """Its effort has another place and sign; an effort of 0.2 closes neither gripper."""
    one = m.DecidedGripper(with_effort(make_role_actor(), effort))
    actor = one if members == 1 else m.DecidedGripper(m.ActorEnsemble([one] * members), 0.0)
    policy = m.TransferredActor(actor, seven_plans()).eval()
    state = state_of(policy, *[PUCK.name] * 4)
    for each in (policy, policy.with_plans(seven_plans()).eval()):
        assert (action_of(each, state)[:, SEVEN.effort] == done).all()
    assert action_of(one.eval(), rows_for(one, 2))[0, 3] == (1.0 if effort > 0.3 else -1.0)


def test_layout_places_the_effort():
    actions = torch.tensor([[0.0] * 6 + [-0.5], [0.0] * 7])
    assert decided(actions, SEVEN).tolist() == [[0] * 6 + [-1], [0] * 6 + [1]]
    assert actions[0, 6] == -0.5


# ---- DemonstratedActor

MT50 = lw.canonical_plans(lw.load_plans("MT50"))


def make_demonstrated():
    return m.DemonstratedActor(make_descriptor(("push", "reach")), make_role_actor(MT50)).eval()


def state_of(policy, *tasks):
    ids = torch.tensor([lw.task_id(task) for task in tasks])
    observation = torch.rand(len(tasks), policy.plans.layout.size)
    return lw.QAFTransform(policy.plans)(TensorDict(observation=observation, task_id=ids, batch_size=[len(tasks)]))


def test_each_row_acts_by_the_policy_of_its_task():
    policy = make_demonstrated()
    state = state_of(policy, "push", "hammer", "reach", "soccer", "push")
    output, seen = policy(state.copy()), torch.tensor([True, False, True, False, True])
    torch.testing.assert_close(output["action"][seen], action_of(policy.demonstrated, state[seen]))
    others = policy.others(state.copy())
    assert torch.equal(output["action"][~seen], others["action"][~seen])
    assert torch.equal(output["skill_weights"], others["skill_weights"])
    assert set(output.keys()) == {*state.keys(), *policy.out_keys}
    assert torch.equal(output["task_id"], state["task_id"])
    assert (policy.plans, policy.tasks) == (policy.others.plans, tuple(MT50))
    for tasks, part in ((("push", "reach"), policy.demonstrated), (("hammer", "soccer"), policy.others)):
        state = state_of(policy, *tasks)
        torch.testing.assert_close(action_of(policy, state), action_of(part, state))


def test_another_suite_leaves_only_the_policy_with_plans():
    fetch = lw.canonical_plans(load_suite("fetch").plans)
    assert type(make_demonstrated().with_plans(fetch)) is lw.PlanConditionedActor
    assert m.TransferredActor(make_demonstrated(), fetch).tasks == tuple(fetch)


# ---- TransferredActor


def test_full_displacement_stays_full_or_keeps_its_metres():
    fetch = lw.canonical_plans(load_suite("fetch").plans)
    features = m.Concat(m.ObservationFeatures("opening"), m.RoleFeatures(CANONICAL))
    actor = make_actor(CANONICAL, features=features)
    rows = torch.rand(20, 4) - 0.5
    reach = METAWORLD.reach / fetch.layout.reach
    for speed, ratio in ((None, 1.0), (1.0, reach), (2.0, 2.0 * reach)):
        moved = m.TransferredActor(actor, fetch, speed=speed)
        output = moved.converted(rows)
        expected = (rows[:, METAWORLD.displaced("test")] * ratio).clamp(-1, 1)
        torch.testing.assert_close(output[:, fetch.layout.displaced("test")], expected)
        assert {id(one) for one in moved.parameters()} == {id(one) for one in actor.parameters()}
    assert action_of(moved, state_of(moved, *["fetch/push"] * 3)).abs().max() <= 1


# ---- all


WRAPPED = {
    "ensemble": lambda: m.ActorEnsemble([make_actor(seed=seed) for seed in range(3)]).eval(),
    "decided": lambda: m.DecidedGripper(m.ActorEnsemble([m.DecidedGripper(make_actor())] * 2), 0.0).eval(),
    "demonstrated": make_demonstrated,
    "transferred": lambda: m.TransferredActor(make_role_actor(), CANONICAL, speed=0.5).eval(),
}


@pytest.mark.parametrize("name", WRAPPED)
def test_assigned_in_keys_reach_the_wrapped_actor(name):
    policy = WRAPPED[name]()
    rows = rows_for(policy, 6)
    inner, expected = next(policy.children()), action_of(policy, rows)
    policy.in_keys = ["state" if key == "observation" else key for key in policy.in_keys]
    moved = rows.exclude("observation").set("state", rows["observation"])
    assert torch.equal(action_of(policy, moved), expected)
    if not isinstance(inner, nn.ModuleList):
        assert "observation" in inner.in_keys, "the wrapped actor itself keeps its names"
