"""FocusFeatures and RoleFeatures: relative positions by hand, contacts from demonstrations, turned scenes."""

import pickle
from copy import deepcopy

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from small_actors import CANONICAL, make_role_actor, make_rows
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

import lw_torchrl as lw
from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.modules import ActorEnsemble, FocusFeatures, PlanAttention, RoleFeatures, transform_of
from lw_torchrl.training.normalization import fit_normalization

ZERO_SHOT = lw.canonical_plans(lw.load_plans("MT50", skills="MT10"))
HAND, OBJECT, SECOND, GOAL = slice(0, 3), slice(4, 7), slice(11, 14), slice(36, 39)


def row_of(plans, task):
    return RoleFeatures(plans).tables.index.row(task)


# ---- FocusFeatures


def focus_of(task, *conditions):
    return FocusFeatures(Plans([ConditionalPlan.from_pairs(task, [(condition, "wait") for condition in conditions])]))


def compared(focus, observation, weights=None):
    """Return the positions of the first and the last clause, (B, 2, 3) metres."""
    weights = torch.ones(len(observation), 1) if weights is None else weights
    output = focus(observation, weights, torch.full((len(observation),), lw.task_id(next(iter(focus.plans)))))
    assert output.shape == (len(observation), 18)
    return output[:, :6].reshape(-1, 2, 3) / 10


@pytest.fixture
def observation():
    return torch.randn(5, 39, generator=torch.Generator().manual_seed(0))


def test_focus_shows_the_first_and_the_last_clause_with_two_objects(observation):
    condition = "the gripper is above the puck and the gripper is open and the puck is near the target location"
    output = compared(focus_of("push", condition), observation)
    torch.testing.assert_close(output[:, 0], observation[:, OBJECT] - observation[:, HAND])
    torch.testing.assert_close(output[:, 1], observation[:, GOAL] - observation[:, OBJECT])
    focus = focus_of("push", "the gripper is not above the puck")
    output = compared(focus, observation)
    assert torch.equal(output[:, 0], output[:, 1])
    squashed = focus(observation, torch.ones(5, 1), torch.full((5,), lw.task_id("push")))[:, 6:]
    torch.testing.assert_close(squashed, torch.cat([torch.tanh(output.flatten(1) / unit) for unit in (0.02, 0.1)], -1))
    assert not compared(focus_of("push", "the gripper is open"), observation).any()


def test_focus_on_points_with_offsets_and_fixed_places(observation):
    output = compared(focus_of("hammer", "the hammer head is near the nail"), observation)
    head = observation[:, OBJECT] + torch.tensor([0.16, 0.06, 0.0])
    torch.testing.assert_close(output[:, 0], observation[:, SECOND] - head)
    output = compared(focus_of("bin-picking", "the gripper is near the other bin"), observation)
    torch.testing.assert_close(output[:, 0], torch.tensor([0.12, 0.7, 0.02]) - observation[:, HAND])


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31))
def test_focus_mixes_steps_by_attention(seed):
    generator = torch.Generator().manual_seed(seed)
    observation = torch.randn(4, 39, generator=generator)
    weights = torch.rand(4, 2, generator=generator).softmax(-1)
    conditions = ("the gripper is above the puck", "the puck is near the target location")
    each = [compared(focus_of("push", condition), observation) for condition in conditions]
    mixed = compared(focus_of("push", *conditions), observation, weights)
    torch.testing.assert_close(mixed, weights[:, 0, None, None] * each[0] + weights[:, 1, None, None] * each[1])


@pytest.mark.parametrize("kind", [FocusFeatures, RoleFeatures])
def test_any_leading_shape_and_noise_in_training_mode(kind):
    features = kind(CANONICAL, noise=0.1).eval()
    rows = make_rows(2, 3, plans=CANONICAL).set("skill_weights", torch.rand(2, 3, CANONICAL.num_steps))
    once = features(rows.copy())["features"]
    assert once.shape == (2, 3, features.width)
    torch.testing.assert_close(features(rows.reshape(6))["features"].reshape(2, 3, -1), once)
    assert not torch.equal(features.train()(rows.copy())["features"], once)


# ---- RoleFeatures


def make_roles(plans=CANONICAL):
    return RoleFeatures(plans).eval()


def in_step(plans, task, step, number=5, seed=0):
    """Return random observations with all attention on one step, as ``positions`` reads them."""
    observation = torch.randn(number, 39, generator=torch.Generator().manual_seed(seed))
    weights = torch.zeros(number, plans.num_steps)
    weights[:, step] = 1.0
    return observation, weights, torch.full((number,), row_of(plans, task))


def written(roles, seen, **more):
    """Return the features (B, 12) of inputs from :func:`in_step`."""
    return roles(rows_of(roles.plans, seen).set("skill_weights", seen[1]).update(more))["features"]


def rows_of(plans, seen):
    ids = torch.tensor([lw.task_id(task) for task in RoleFeatures(plans).tables.index.tasks])[seen[2]]
    return TensorDict(observation=seen[0], task_id=ids, batch_size=[len(ids)])


WAYS = [("push", 0, HAND, OBJECT, 0.0), ("push", 3, OBJECT, GOAL, 0.0), ("assembly", 3, OBJECT, GOAL, 0.13)]
WAYS += [("peg-unplug-side", 3, OBJECT, GOAL, 0.0)]  # the goal, which that task has no name for


@pytest.mark.parametrize(("task", "step", "moved", "target", "beside"), WAYS)
def test_position_points_from_the_moved_object_to_the_target(task, step, moved, target, beside):
    seen, roles = in_step(ZERO_SHOT, task, step), make_roles(ZERO_SHOT)
    roles.demonstrated.fill_(True)
    way = seen[0][:, target] - seen[0][:, moved] + torch.tensor([beside, 0.0, 0.0])
    torch.testing.assert_close(roles.positions(*seen)[:, 0], way)


DIRECTIONS = [("push", 0, (0.0, 0.0, 0.0)), ("drawer-open", 2, (0.0, -1.0, 0.0)), ("window-open", 2, (1.0, 0.0, 0.0))]
DIRECTIONS += [("window-open", 0, (1.0, 0.0, 0.0)), ("button-press-topdown", 2, (0.0, 0.0, -1.0))]


@pytest.mark.parametrize(("task", "step", "direction"), DIRECTIONS)
def test_direction_of_a_step(task, step, direction):
    roles, seen = make_roles(), in_step(CANONICAL, task, step)
    assert torch.equal(roles.directions(*seen), torch.tensor(direction).expand(5, 3))
    assert torch.equal(written(roles, seen)[:, 9:], torch.tensor(direction).expand(5, 3))


def push_plan(verb, *pairs):
    """Return a canonical plan of push, and the number of its step with a verb."""
    plans = lw.canonical_plans(Plans([ConditionalPlan.from_pairs("push", pairs)]))
    return plans, [step.role.verb for step in plans["push"].steps].index(verb)


def turned_by_any_angle(observation):
    return lw.RandomYaw(0.7)(TensorDict(observation=observation, action=torch.zeros(5, 4), batch_size=[5]))


def test_direction_to_the_goal_starts_at_the_object_and_turns_with_the_scene():
    push = ("gripper is near the puck", "push the puck to the target location")
    plans, number = push_plan("push", ("gripper is not near the puck", "lower the gripper beside the puck"), push)
    roles, (observation, weights, rows) = make_roles(plans), in_step(plans, "push", number)
    ahead = torch.nn.functional.normalize(observation[:, 36:39] - observation[:, 4:7], dim=-1)
    torch.testing.assert_close(roles.directions(observation, weights, rows), ahead)
    turned = turned_by_any_angle(observation)
    after = roles.directions(turned["observation"], weights, rows, turned["observation_yaw"])
    now = torch.nn.functional.normalize(turned["observation"][:, 36:39] - turned["observation"][:, 4:7], dim=-1)
    torch.testing.assert_close(after, now)
    observation[:, 36:39] = observation[:, 4:7]
    assert not roles.directions(observation, weights, rows).any(), "it is there already"


def test_object_that_is_lifted_has_a_target_above_it():
    lower = ("gripper is not near the puck", "lower the gripper around the puck")
    close = ("gripper is near the puck and gripper is open", "close the gripper around the puck")
    plans, number = push_plan("move", lower, close, ("gripper is near the puck and gripper is closed", "lift the puck"))
    seen = in_step(plans, "push", number)
    torch.testing.assert_close(make_roles(plans).positions(*seen)[:, 0], torch.tensor([0.0, 0.0, 0.15]).expand(5, 3))
    assert not make_roles(plans).directions(*seen).any()


def test_position_is_clipped_at_25_cm():
    roles = make_roles()
    observation, *rest = in_step(CANONICAL, "push", 0)
    observation[:, :3] = observation[:, 4:7] + torch.tensor([0.3, -0.4, 0.0])
    far = written(roles, (observation, *rest))
    torch.testing.assert_close(far[:, :3] * 0.1, torch.tensor([-0.15, 0.2, 0.0]).expand(5, 3))
    observation[:, :3] = observation[:, 4:7] + torch.tensor([0.15, -0.2, 0.0])
    torch.testing.assert_close(written(roles, (observation, *rest)), far)
    observation[:, :3] = observation[:, 4:7] + torch.tensor([0.1, 0.0, 0.0])
    torch.testing.assert_close(written(roles, (observation, *rest))[:, 0], torch.full((5,), -1.0))


LIFTED = [(0.2, 0.0, (0.0, 0.0, 0.15)), (0.2, -0.13, (0.2, 0.0, 0.02))]  # far away: straight up first; high: aside
LIFTED += [(0.2, -0.11, (0.1, 0.0, 0.04)), (0.02, -0.15, (0.02, 0.0, -0.15)), (0.0, 0.0, (0.0, 0.0, 0.0))]  # both; down


@pytest.mark.parametrize(("beside", "below", "expected"), LIFTED)
def test_without_demonstrations_a_carried_object_is_lifted_first(beside, below, expected):
    roles, seen = make_roles(), in_step(CANONICAL, "push", 3, number=1)
    seen[0][:, OBJECT] = seen[0][:, GOAL] - torch.tensor([beside, 0.0, below])
    torch.testing.assert_close(roles.positions(*seen)[0, 0], torch.tensor(expected), atol=1e-5, rtol=0)
    roles.fit(rows_of(CANONICAL, in_step(CANONICAL, "push", 0)))
    assert roles.demonstrated.tolist() == [task == "push" for task in roles.tables.index.tasks]
    torch.testing.assert_close(roles.positions(*seen)[0, 0], torch.tensor((beside, 0.0, below)), atol=1e-5, rtol=0)


def test_a_sliding_object_is_not_lifted():
    roles = make_roles()
    observation, weights, rows = in_step(CANONICAL, "peg-insert-side", 4)
    before = roles.positions(observation, weights, rows)
    roles.demonstrated.fill_(True)
    assert torch.equal(roles.positions(observation, weights, rows), before)


def demonstrations(task):
    rows = lw.LanguageWorldEnv(task, num_envs=2).rollout(160, lw.ExpertActor(task), break_when_any_done=False)
    return rows.flatten().select("observation", "task_id", "action")


def test_contact_is_the_hand_position_while_it_acts():
    roles, rows = make_roles(), demonstrations("drawer-open")
    roles.fit(demonstrations("button-press-topdown"))
    assert not roles.contact.any(), "a button is pressed from above"
    assert roles.demonstrated.sum() == 1
    roles = make_roles()
    roles.fit(rows)
    attended = PlanAttention(CANONICAL)(lw.QAFTransform(CANONICAL)(rows.copy()))["skill_weights"]
    pull = [step.role.verb for step in CANONICAL["drawer-open"].steps].index("pull")
    observation = rows["observation"][attended[:, pull] > 0.5]
    assert 10 < len(observation) < len(rows)
    row = row_of(CANONICAL, "drawer-open")
    expected = (observation[:, HAND] - observation[:, OBJECT]).median(0).values
    torch.testing.assert_close(roles.contact[row], expected)
    observation, *rest = in_step(CANONICAL, "drawer-open", pull)
    observation[:, HAND] = observation[:, OBJECT] + roles.contact[row]
    at_contact = roles.positions(observation, *rest)
    torch.testing.assert_close(at_contact, torch.zeros_like(at_contact), atol=1e-5, rtol=0)


def test_contacts_affect_neither_carried_objects_nor_named_points():
    roles = make_roles(ZERO_SHOT)
    roles.contact.fill_(1.0)
    roles.demonstrated.fill_(True)
    carried, point = in_step(ZERO_SHOT, "push", 3), in_step(ZERO_SHOT, "coffee-pull", 0)
    torch.testing.assert_close(roles.positions(*carried)[:, 0], carried[0][:, 36:39] - carried[0][:, 4:7])
    rim = torch.tensor([-0.005, 0.0, 0.05])
    torch.testing.assert_close(roles.positions(*point)[:, 0], point[0][:, 4:7] + rim - point[0][:, :3])


@pytest.mark.parametrize(("task", "step"), [("push", 0), ("peg-insert-side", 4), ("drawer-open", 2)])
def test_turned_scene_turns_positions_fixed_places_and_contacts(task, step):
    """The hole of peg-insert-side has a fixed x, which no turned observation holds."""
    roles = make_roles()
    roles.contact.copy_(torch.rand(roles.contact.shape))
    observation, weights, rows = in_step(CANONICAL, task, step)
    turned = turned_by_any_angle(observation)
    yaw = turned["observation_yaw"]
    x, y, z = roles.positions(observation, weights, rows)[:, 0].unbind(-1)
    after = roles.positions(turned["observation"], weights, rows, yaw)[:, 0]
    turned_by_hand = torch.stack([yaw.cos() * x - yaw.sin() * y, yaw.sin() * x + yaw.cos() * y, z], -1)
    torch.testing.assert_close(after, turned_by_hand)


def test_target_offset_moves_the_position():
    roles, seen = make_roles(), in_step(CANONICAL, "drawer-open", 2)
    offset = torch.full((5, 3), 0.01)
    plain, moved = written(roles, seen), written(roles, seen, target_offset=offset)
    position = roles.positions(*seen)[:, 0] + offset
    position = position * (0.25 / position.norm(dim=-1, keepdim=True).clamp(min=0.25))
    torch.testing.assert_close(moved[:, :3] * 0.1, position)
    assert torch.equal(moved[:, 9:], plain[:, 9:])


def test_training_fits_contacts_that_actors_with_the_same_weights_and_the_policy_file_share(tmp_path):
    actor, row, wide_row = (make_role_actor(), *(row_of(plans, "drawer-open") for plans in (CANONICAL, ZERO_SHOT)))
    copies = [pickle.loads(pickle.dumps(actor)), deepcopy(actor)]
    wider = actor.with_plans(ZERO_SHOT)
    back = wider.with_plans(CANONICAL)
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(400), batch_size=8, transform=transform_of(actor))
    replay.extend(demonstrations("drawer-open"))
    config = lw.BehavioralCloningConfig(steps=2, batch_size=8)
    lw.BehavioralCloningTrainer(back, replay, config, progress=False).train()
    contact = back.features.contact
    assert contact[row].any()
    assert torch.equal(wider.features.contact[wide_row], contact[row])
    lw.save_actor(back, tmp_path / "policy.safetensors")
    loaded = lw.load_actor(tmp_path / "policy.safetensors")
    ensemble = ActorEnsemble([make_role_actor(seed=seed) for seed in range(2)])
    assert not any(each.features.fitted for each in (*copies, *ensemble.members))
    for each in (*copies, ensemble):
        fit_normalization(each, replay)
    for each in (actor, back, loaded, *copies, *ensemble.members):
        assert torch.equal(each.features.contact, contact)
    for features in (each.features for each in (actor, wider, back, loaded)):
        assert features.fitted
        assert features.demonstrated.tolist() == [task == "drawer-open" for task in features.tables.index.tasks]
        assert features.contact.count_nonzero() == 3
