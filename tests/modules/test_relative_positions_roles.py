"""PlanRoles: the way from what is moved to its target, to where demonstrations touch things, turned as the scene is."""

import pickle
from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.objectives import TD3Loss

import lw_torchrl as lw
from lw_torchrl.language.task_index import PlanTables
from lw_torchrl.modules.relative_positions import PlanRoles
from lw_torchrl.training.normalization import fit_normalization

MT10 = lw.load_plans("MT10")
ZERO_SHOT = lw.load_plans("MT50", skills="MT10")
OPTIONS = {"roles": True, "features": "opening", "feature_noise": 0.0}


def roles_of(plans=MT10, **options):
    return PlanRoles(plans, PlanTables(plans), **options).eval()


def in_step(plans, task, step, number=5, seed=0):
    """Random observations, with all attention on one step of a task."""
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
        ("bin-picking", 3, lambda o: torch.tensor([0.12, 0.7, 0.02]) - o[:, 4:7]),
        ("peg-unplug-side", 2, lambda o: o[:, 36:39] - o[:, 4:7]),  # the goal, which that task has no name for
    ],
)
def test_the_position_is_from_what_is_moved_to_the_target(task, step, way):
    seen = in_step(ZERO_SHOT, task, step)
    found = roles_of(ZERO_SHOT).positions(*seen)
    torch.testing.assert_close(found[:, 0], way(seen[0]))


def test_a_step_without_roles_has_no_way_and_its_features_are_0():
    plans = lw.Plans([lw.ConditionalPlan.from_pairs("push", [("gripper is open", "wait")])])
    assert not roles_of(plans)(*in_step(plans, "push", 0)).any()


def demonstrations(task, contact):
    """Rows in each step of a task's plan, the hand at the contact with the first object, and their attention."""
    parts = [in_step(MT10, task, step, seed=step) for step in range(len(MT10[task].steps))]
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
    lw.save_actor(actor, tmp_path / "policy.zip")
    assert torch.equal(lw.load_actor(tmp_path / "policy.zip").encoder.roles.contact, contact)
    wider = actor.with_plans(ZERO_SHOT).encoder.roles
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
    assert all(one.encoder.roles.fitted for one in (actor, wider, back))
    for other in copies:
        assert not other.encoder.roles.fitted
        fit_normalization(other, replay)
        assert torch.equal(other.encoder.roles.contact, contact)


def test_training_without_statistics_wants_contacts_first():
    config = lw.BehavioralCloningConfig(steps=1, batch_size=8, normalize=False)
    actor, replay = lw.PlanConditionedActor(MT10, **OPTIONS), make_replay()
    replay.append_transform(actor.transform())
    for make in (
        lambda: lw.BehavioralCloningTrainer(actor, replay, config, progress=False),
        lambda: lw.training.StackedBehavioralCloning([actor], [replay], config, progress=False),
    ):
        with pytest.raises(ValueError, match=r"roles want to know .*; call fit_normalization\(actor, replay\)"):
            make()
    fit_normalization(actor, replay)
    lw.BehavioralCloningTrainer(actor, replay, config, progress=False).train()


def test_the_opening_is_hidden_but_where_a_step_closes():
    actor = lw.PlanConditionedActor(MT10, hide_opening=1.0, **OPTIONS)
    row, number = lw.task_id("push"), 200
    for step, hidden in ((0, True), (2, False)):  # place above; close around
        qaf = torch.zeros(number, MT10.num_steps, dtype=torch.bool)
        qaf[:, step] = True
        observation = torch.rand(number, 39)
        state = TensorDict(observation=observation, task_id=torch.full((number,), row), qaf=qaf, batch_size=[number])
        seen = actor.train().prepare(state)[2][:, 0]
        assert torch.equal(seen, observation[:, 3]) is not hidden
        assert set(seen.tolist()) <= set(observation[:, 3].tolist())
        assert torch.equal(actor.eval().prepare(state)[2][:, 0], observation[:, 3])
        assert torch.equal(state["observation"], observation)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"jitter": 0.1}, "jitter moves the way of the roles, and roles is False; got jitter=0.1"),
        ({"roles": True, "jitter": -1.0}, "jitter must be finite and at least 0"),
        ({"hide_opening": 1.5}, "hide_opening must be"),
        ({"hide_opening": 0.5, "features": "relative"}, "hide_opening: features='relative' do not show the opening"),
        ({"features": "opening"}, "features='opening' shows nothing of where things are; it needs roles=True or"),
        *(
            ({"roles": True, "distribution": "tanh_normal", name: 0.1}, "jitter, .* must be 0 with a distribution")
            for name in ("jitter", "swap_unmentioned", "hide_opening")
        ),
        ({"roles": True, "evaluator": lw.StateQueryEvaluator(MT10)}, "focus, roles, .* an evaluator takes away"),
    ],
)
def test_wrong_options_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        lw.PlanConditionedActor(MT10, **options)
