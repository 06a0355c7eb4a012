"""decided_gripper: fingers that open or close fully when a policy acts, whoever is asked and whatever the robot."""

import pytest
import torch
from tensordict import TensorDict

import lw_torchrl as lw
from lw_torchrl.language.layout import Layout, Slot
from lw_torchrl.language.named_objects import GRIPPER, NamedObject
from lw_torchrl.modules import ActorEnsemble, TransferredActor
from lw_torchrl.modules.policy import decided

PLANS = lw.load_plans("MT10")
SMALL = {"width": 8, "depth": 1}
KINDS = {
    "plans": lambda **options: lw.PlanConditionedActor(PLANS, **SMALL, **options),
    "description": lambda **options: lw.DescriptorConditionedActor("MT10", **SMALL, **options),
}


def make_state(rows=200, actor=None):
    ids = torch.tensor([lw.task_id(task) for task in lw.MT10])[torch.arange(rows) % 10]
    state = TensorDict(observation=torch.rand(rows, 39), task_id=ids).auto_batch_size_()
    return (lw.QAFTransform(PLANS) if actor is None else actor.transform())(state)


def with_effort(actor, effort):
    """The actor, whose last layer gives an effort whatever it sees."""
    *_, last = (part for part in actor.head.modules() if isinstance(part, torch.nn.Linear))
    with torch.no_grad():
        last.weight[3] = 0.0
        last.bias[3] = torch.atanh(torch.tensor(effort))
    return actor.eval()


@pytest.mark.parametrize("kind", KINDS)
def test_only_when_it_acts(kind):
    actor, state = KINDS[kind](decided_gripper=True), make_state()
    effort = actor.train()(state.clone())["action"][:, 3]
    assert effort.unique().numel() > 2
    actor = KINDS[kind](decided_gripper=True, feature_noise=0.0)
    asked = actor.train()(state.clone())["action"]
    done = actor.eval()(state.clone())["action"]
    torch.testing.assert_close(done[:, :3], asked[:, :3])
    assert torch.equal(done[:, 3], torch.where(asked[:, 3] > 0.3, 1.0, -1.0))


@pytest.mark.parametrize(("effort", "done"), [(0.29, -1.0), (0.31, 1.0), (-0.9, -1.0), (1e-3, -1.0)])
def test_it_closes_above_the_layout_s_effort(effort, done):
    actor = with_effort(KINDS["plans"](decided_gripper=True), effort)
    assert (actor(make_state(10))["action"][:, 3] == done).all()


@pytest.mark.parametrize(("efforts", "done"), [((0.9, 0.35, -0.9), 1.0), ((0.9, 0.2, 0.2), -1.0)])
def test_of_an_ensemble_most_members_decide(efforts, done):
    members = [with_effort(KINDS["plans"](decided_gripper=True), effort) for effort in efforts]
    ensemble = ActorEnsemble(members).eval()
    assert (ensemble(make_state(10))["action"][:, 3] == done).all()
    assert ensemble.train()(make_state(10))["action"][:, 3].abs().max() < 1


def test_one_that_is_not_asked_to_decide_does_not():
    ensemble = ActorEnsemble([with_effort(KINDS["plans"](), effort) for effort in (0.5, 0.7)]).eval()
    torch.testing.assert_close(ensemble(make_state(3))["action"][:, 3], torch.full((3,), 0.6))


SEVEN = Layout(
    "seven", 16, hand=1, opening=0, things=(Slot(4),), goal=13, action_size=7, displacement=1, gripper=6, closes=-1
)
PUCK = lw.Task("seven/push", "Push it.", (NamedObject(GRIPPER, (1, 2, 3)), NamedObject("puck", (4, 5, 6))), SEVEN)


@pytest.mark.parametrize(("effort", "done"), [(0.2, 1.0), (0.4, -1.0), (-0.2, 1.0)])
@pytest.mark.parametrize("members", [1, 3])
def test_with_another_robot_it_decides_by_the_one_that_it_learned_with(effort, done, members):
    """That one's effort stands elsewhere and has another sign, and 0.2 does not close with either."""
    options = {"roles": True, "features": "none", "decided_gripper": True}
    one = with_effort(lw.PlanConditionedActor(PLANS, **SMALL, **options), effort)
    steps = [(step.condition, step.skill) for step in PLANS["push"].steps[:3]]
    plan = lw.ConditionalPlan.from_pairs(
        PUCK,
        [
            (str(condition).replace("touching the table", "above the robot's gripper"), skill)
            for condition, skill in steps
        ],
    )
    actor = TransferredActor(one if members == 1 else ActorEnsemble([one] * members), lw.Plans([plan])).eval()
    again = actor.with_plans(lw.Plans([plan]))
    state = TensorDict(observation=torch.rand(4, 16), task_id=torch.full((4,), lw.task_id(PUCK.name)))
    state = actor.transform()(state.auto_batch_size_())
    for each in (actor, again):
        assert (each(state.clone())["action"][:, SEVEN.effort] == done).all()
    assert one.acts_in is None
    assert one(make_state(2, one))["action"][0, 3] == (1.0 if effort > 0.3 else -1.0)


def test_the_effort_is_where_the_layout_has_it():
    given = torch.zeros(2, 7)
    given[0, 6] = -0.5
    assert decided(given, SEVEN)[:, 6].tolist() == [-1.0, 1.0]
    assert not decided(given, SEVEN)[:, :6].any()
    assert given[0, 6] == -0.5


def test_it_is_kept_in_a_file_and_a_distribution_refuses_it(tmp_path):
    actor = KINDS["plans"](decided_gripper=True).eval()
    lw.save_actor(actor, tmp_path / "policy.safetensors")
    assert lw.load_actor(tmp_path / "policy.safetensors")(make_state())["action"][:, 3].abs().eq(1.0).all()
    assert not actor.stochastic().decided_gripper
    assert actor.with_plans(lw.load_plans("MT50")).decided_gripper
    with pytest.raises(ValueError, match="decided_gripper must be false with a distribution, which draws any effort"):
        KINDS["plans"](decided_gripper=True, distribution="normal")
    with pytest.raises(TypeError, match="decided_gripper must be"):
        KINDS["plans"](decided_gripper="yes")
