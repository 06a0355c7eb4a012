"""PlanRoles: the way from what is moved to its target, to where demonstrations touch things, turned as the scene is."""

import pickle
from copy import deepcopy

import pytest
import torch
from lw_torchrl.language.canonical_steps import read_canonical
from lw_torchrl.modules.relative_positions import PlanRoles
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.objectives import TD3Loss

import lw_torchrl as lw
from lw_torchrl.language.task_index import PlanTables
from lw_torchrl.training.normalization import fit_normalization

MT10 = lw.load_plans("MT10")
ZERO_SHOT = lw.load_plans("MT50", skills="MT10")
OPTIONS = {"roles": True, "features": "opening", "feature_noise": 0.0}


def seen_of(plans):
    """The canonical plans, which policies see."""
    return lw.Plans([read_canonical(plan).plan for plan in plans.values()])


def roles_of(plans=MT10, **options):
    canonical = {task: read_canonical(plan) for task, plan in plans.items()}
    return PlanRoles(canonical, PlanTables(seen_of(plans)), **options).eval()


def in_step(plans, task, step, number=5, seed=0):
    """Random observations, with all attention on one step of a task's canonical plan."""
    plans = seen_of(plans)
    observation = torch.randn(number, 39, generator=torch.Generator().manual_seed(seed))
    weights = torch.zeros(number, plans.num_steps)
    weights[:, step] = 1.0
    return observation, weights, torch.full((number,), PlanTables(plans).index.row(task))


@pytest.mark.parametrize(
    ("task", "step", "way"),
    [
        ("push", 0, lambda o: o[:, 4:7] - o[:, :3]),
        ("push", 3, lambda o: o[:, 36:39] - o[:, 4:7]),
        ("assembly", 3, lambda o: o[:, 36:39] - o[:, 4:7] - torch.tensor([-0.13, 0.0, 0.0])),
        ("peg-unplug-side", 3, lambda o: o[:, 36:39] - o[:, 4:7]),  # the goal, which that task has no name for
    ],
)
def test_the_position_is_from_what_is_moved_to_the_target(task, step, way):
    seen, roles = in_step(ZERO_SHOT, task, step), roles_of(ZERO_SHOT)
    roles.demonstrated.fill_(True)
    torch.testing.assert_close(roles.positions(*seen)[:, 0], way(seen[0]))


@pytest.mark.parametrize(
    ("task", "step", "direction"),
    [("push", 0, (0.0, 0.0, 0.0)), ("drawer-open", 2, (0.0, -1.0, 0.0)), ("window-open", 2, (1.0, 0.0, 0.0)),
     ("window-open", 0, (1.0, 0.0, 0.0)), ("button-press-topdown", 2, (0.0, 0.0, -1.0))],
)  # fmt: skip
def test_a_step_shows_the_direction_that_it_says(task, step, direction):
    roles, seen = roles_of(), in_step(MT10, task, step)
    assert torch.equal(roles.directions(*seen), torch.tensor(direction).expand(5, 3))
    assert torch.equal(roles(*seen)[:, 9:], torch.tensor(direction).expand(5, 3))


def test_toward_the_goal_is_from_the_thing_to_it_and_turns_with_the_scene():
    pairs = [
        ("gripper is not near the puck", "lower the gripper beside the puck"),
        ("gripper is near the puck", "push the puck to the target location"),
    ]
    plans = lw.Plans([lw.ConditionalPlan.from_pairs("push", pairs)])
    (number,) = (n for n, one in enumerate(read_canonical(plans["push"]).steps) if one.verb == "push")
    roles, (observation, weights, rows) = roles_of(plans), in_step(plans, "push", number)
    ahead = torch.nn.functional.normalize(observation[:, 36:39] - observation[:, 4:7], dim=-1)
    torch.testing.assert_close(roles.directions(observation, weights, rows), ahead)
    turned = lw.RandomYaw(0.7)(TensorDict(observation=observation, action=torch.zeros(5, 4), batch_size=[5]))
    yaw = turned["observation_yaw"]
    after = roles.directions(turned["observation"], weights, rows, yaw)
    now = torch.nn.functional.normalize(turned["observation"][:, 36:39] - turned["observation"][:, 4:7], dim=-1)
    torch.testing.assert_close(after, now)
    observation[:, 36:39] = observation[:, 4:7]
    assert not roles.directions(observation, weights, rows).any(), "there is no way left"


def test_what_is_moved_to_a_side_has_a_place_there():
    pairs = [
        ("gripper is not near the puck", "lower the gripper around the puck"),
        ("gripper is near the puck and gripper is open", "close the gripper around the puck"),
        ("gripper is near the puck and gripper is closed", "lift the puck"),
    ]
    plans = lw.Plans([lw.ConditionalPlan.from_pairs("push", pairs)])
    (number,) = (n for n, one in enumerate(read_canonical(plans["push"]).steps) if one.verb == "move")
    seen = in_step(plans, "push", number)
    torch.testing.assert_close(roles_of(plans).positions(*seen)[:, 0], torch.tensor([0.0, 0.0, 0.15]).expand(5, 3))
    assert not roles_of(plans).directions(*seen).any()


def test_beyond_25_cm_only_the_direction_is_seen():
    roles = roles_of()
    observation, weights, rows = in_step(MT10, "push", 0)
    observation[:, :3] = observation[:, 4:7] + torch.tensor([0.3, -0.4, 0.0])
    far = roles(observation, weights, rows)
    torch.testing.assert_close(far[:, :3] * 0.1, torch.tensor([-0.15, 0.2, 0.0]).expand(5, 3))
    observation[:, :3] = observation[:, 4:7] + torch.tensor([0.15, -0.2, 0.0])
    torch.testing.assert_close(roles(observation, weights, rows), far)
    observation[:, :3] = observation[:, 4:7] + torch.tensor([0.1, 0.0, 0.0])
    torch.testing.assert_close(roles(observation, weights, rows)[:, 0], torch.full((5,), -1.0))


def carried(beside, below):
    """One row in which the puck is carried, so far beside its target and so far below it, metres."""
    observation, weights, rows = in_step(MT10, "push", 3, number=1)
    observation[:, 4:7] = observation[:, 36:39] - torch.tensor([beside, 0.0, below])
    return observation, weights, rows


@pytest.mark.parametrize(
    ("beside", "below", "wanted"),
    [
        (0.2, 0.0, (0.0, 0.0, 0.15)),  # far away: first straight up
        (0.2, -0.13, (0.2, 0.0, 0.02)),  # high: to the side
        (0.2, -0.11, (0.1, 0.0, 0.04)),  # in between: both
        (0.02, -0.15, (0.02, 0.0, -0.15)),  # over it: down
        (0.0, 0.0, (0.0, 0.0, 0.0)),
    ],
)
def test_what_is_carried_in_a_task_without_demonstrations_is_lifted_first(beside, below, wanted):
    roles, seen = roles_of(), carried(beside, below)
    torch.testing.assert_close(roles.positions(*seen)[0, 0], torch.tensor(wanted), atol=1e-5, rtol=0)
    roles.fit(*in_step(MT10, "push", 0))
    assert roles.demonstrated.tolist() == [task == "push" for task in roles.tables.index.tasks]
    torch.testing.assert_close(roles.positions(*seen)[0, 0], torch.tensor((beside, 0.0, below)), atol=1e-5, rtol=0)


def test_what_is_slid_or_approached_is_not_lifted():
    roles = roles_of()
    observation, weights, rows = in_step(MT10, "peg-insert-side", 4)
    before = roles.positions(observation, weights, rows)
    roles.demonstrated.fill_(True)
    assert torch.equal(roles.positions(observation, weights, rows), before)


def demonstrations(task, contact):
    """Rows in each step of a task's plan, the hand at the contact with the first object, and their attention."""
    parts = [in_step(MT10, task, step, seed=step) for step in range(len(seen_of(MT10)[task].steps))]
    observation, weights, rows = (torch.cat(column) for column in zip(*parts, strict=True))
    observation[:, :3] = observation[:, 4:7] + torch.tensor(contact)
    return observation, weights, rows


def test_contacts_are_where_the_hand_is_when_it_acts():
    roles = roles_of()
    observation, weights, rows = demonstrations("drawer-open", (0.01, -0.02, 0.03))
    acting = weights[:, 2] == 1  # it pulls
    observation[~acting, :3] += 1.0
    roles.fit(observation, weights, rows)
    row = PlanTables(MT10).index.row("drawer-open")
    torch.testing.assert_close(roles.contact[row], torch.tensor([0.01, -0.02, 0.03]), atol=1e-5, rtol=0)
    assert roles.contact.count_nonzero() == 3
    at_contact = roles.positions(observation[acting], weights[acting], rows[acting])
    torch.testing.assert_close(at_contact, torch.zeros_like(at_contact), atol=1e-5, rtol=0)


def test_what_is_pressed_from_above_has_no_contact():
    roles = roles_of()
    roles.fit(*demonstrations("button-press-topdown", (0.0, 0.0, 0.04)))
    assert not roles.contact.any()


def test_contacts_do_not_move_the_way_of_what_is_carried_nor_of_named_points():
    roles = roles_of(ZERO_SHOT)
    roles.contact.fill_(1.0)
    roles.demonstrated.fill_(True)
    carried, point = in_step(ZERO_SHOT, "push", 3), in_step(ZERO_SHOT, "coffee-pull", 0)
    torch.testing.assert_close(roles.positions(*carried)[:, 0], carried[0][:, 36:39] - carried[0][:, 4:7])
    rim = torch.tensor([-0.005, 0.0, 0.05])
    torch.testing.assert_close(roles.positions(*point)[:, 0], point[0][:, 4:7] + rim - point[0][:, :3])


@pytest.mark.parametrize(("task", "step"), [("push", 0), ("peg-insert-side", 4), ("drawer-open", 2)])
def test_a_turned_scene_turns_the_way_fixed_places_and_contacts_too(task, step):
    """The hole of peg-insert-side has a fixed x, which no turned observation holds."""
    roles = roles_of()
    roles.contact.copy_(torch.rand(roles.contact.shape))
    observation, weights, rows = in_step(MT10, task, step)
    sample = TensorDict(observation=observation, action=torch.zeros(5, 4), batch_size=[5])
    turned = lw.RandomYaw(0.7)(sample)
    yaw = turned["observation_yaw"]
    before = roles.positions(observation, weights, rows)[:, 0]
    after = roles.positions(turned["observation"], weights, rows, yaw)[:, 0]
    x, y = before[:, 0], before[:, 1]
    torch.testing.assert_close(after[:, 0], yaw.cos() * x - yaw.sin() * y)
    torch.testing.assert_close(after[:, 1], yaw.sin() * x + yaw.cos() * y)
    torch.testing.assert_close(after[:, 2], before[:, 2])


def test_jitter_is_for_pushing_while_training():
    roles = roles_of(jitter=0.03)
    push, place = in_step(MT10, "drawer-open", 2, 4_000), in_step(MT10, "drawer-open", 0, 4_000)
    still = roles.positions(*push)
    assert torch.equal(still, roles.positions(*push))
    roles.train()
    spread = (roles.positions(*push) - still).flatten(0, 1).std(0)
    torch.testing.assert_close(spread, torch.tensor([0.015, 0.015, 0.03]), atol=0.002, rtol=0)
    assert torch.equal(roles.positions(*place), roles.eval().positions(*place))


def make_replay(task="drawer-open"):
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(160), batch_size=8)
    env = lw.LanguageWorldEnv(task)
    rollout = env.rollout(160, lw.ExpertActor(task), break_when_any_done=False)
    env.close()
    replay.extend(rollout.flatten().select("observation", "task_id", "action"))
    return replay


def test_training_takes_contacts_and_they_go_with_the_policy(tmp_path):
    torch.manual_seed(0)
    actor = lw.PlanConditionedActor(MT10, **OPTIONS)
    replay = make_replay()
    replay.append_transform(actor.transform())
    lw.BehavioralCloningTrainer(
        actor, replay, lw.BehavioralCloningConfig(steps=2, batch_size=8), progress=False
    ).train()
    contact = actor.encoder.roles.contact
    row = PlanTables(MT10).index.row("drawer-open")
    assert contact[row].any()
    lw.save_actor(actor, tmp_path / "policy.safetensors")
    loaded = lw.load_actor(tmp_path / "policy.safetensors").encoder.roles
    assert torch.equal(loaded.contact, contact)
    assert loaded.demonstrated.tolist() == [task == "drawer-open" for task in MT10]
    wider = actor.with_plans(ZERO_SHOT).encoder.roles
    assert wider.demonstrated.tolist() == [task == "drawer-open" for task in ZERO_SHOT]
    assert torch.equal(wider.contact[PlanTables(ZERO_SHOT).index.row("drawer-open")], contact[row])
    assert wider.contact.count_nonzero() == contact.count_nonzero()
    ensemble = lw.modules.ActorEnsemble([lw.PlanConditionedActor(MT10, **OPTIONS) for _ in range(2)])
    fit_normalization(ensemble, replay)
    assert all(torch.equal(member.encoder.roles.contact, contact) for member in ensemble.members)


def test_a_loss_of_an_actor_without_contacts_is_refused():
    replay, actor = make_replay(), lw.PlanConditionedActor(MT10, **OPTIONS)
    make_loss = lambda: TD3Loss(actor, lw.PlanConditionedQValue(MT10), bounds=(-1.0, 1.0))  # noqa: E731
    with pytest.raises(ValueError, match=r"roles: .* before the loss is made of the actor"):
        fit_normalization(make_loss(), replay)
    fit_normalization(actor, replay)
    fit_normalization(make_loss(), replay)


def test_actors_with_the_same_weights_have_the_same_contacts_whichever_is_fitted():
    replay, row = make_replay(), PlanTables(MT10).index.row("drawer-open")
    actor = lw.PlanConditionedActor(MT10, **OPTIONS)
    copies = [pickle.loads(pickle.dumps(actor)), deepcopy(actor)]
    wider = actor.with_plans(ZERO_SHOT)
    back = wider.with_plans(MT10)
    fit_normalization(back, replay)
    contact = back.encoder.roles.contact
    assert contact[row].any()
    assert torch.equal(actor.encoder.roles.contact, contact)
    assert torch.equal(wider.encoder.roles.contact[PlanTables(ZERO_SHOT).index.row("drawer-open")], contact[row])
    for one in (actor, wider, back):
        assert one.encoder.roles.fitted
        assert one.encoder.roles.demonstrated.sum() == 1
    for other in copies:
        assert not other.encoder.roles.fitted
        fit_normalization(other, replay)
        assert torch.equal(other.encoder.roles.contact, contact)


def test_training_without_statistics_wants_contacts_first():
    config = lw.BehavioralCloningConfig(steps=1, batch_size=8, normalize=False)
    actor, replay = lw.PlanConditionedActor(MT10, **OPTIONS), make_replay()
    replay.append_transform(actor.transform())
    with pytest.raises(ValueError, match=r"roles want to know .*; call fit_normalization\(actor, replay\)"):
        lw.BehavioralCloningTrainer(actor, replay, config, progress=False)
    fit_normalization(actor, replay)
    lw.BehavioralCloningTrainer(actor, replay, config, progress=False).train()
