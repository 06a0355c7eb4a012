"""A robot of another size, brought as a user would: joints for actions, and things that open, turn and slide."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from rerun.chunk import RrdReader
from torchrl.envs import TransformedEnv, check_env_specs
from torchrl.objectives import TD3Loss

import lw_torchrl as lw
from lw_torchrl.language.named_objects import NamedObject
from lw_torchrl.language.relations import PREDICATES, STATES, Comparison
from lw_torchrl.language.skills import ScriptedSkill
from lw_torchrl.suites import check_suite

pytest.importorskip("gymnasium_robotics")
from gymnasium_robotics.envs.franka_kitchen.kitchen_env import KitchenEnv
from kitchen_suite import (
    CABINET,
    JOINTED,
    KITCHEN,
    MICROWAVE,
    PLANS,
    KitchenEngine,
    Pusher,
    make_suite,
)

SUITE = make_suite()
BOTH = ("kitchen/microwave", "kitchen/slide-cabinet")
DOOR = MICROWAVE.openings["microwave"]


def letters(texts):
    return torch.tensor([[float(text.count(letter)) for letter in "aeioust"] for text in texts])


SMALL = {"width": 32, "depth": 1, "latent_size": 4, "text_encoder": letters}


@pytest.fixture
def env():
    env = TransformedEnv(lw.LanguageWorldEnv("kitchen", suite=SUITE, num_envs=4), lw.QAFTransform(PLANS))
    yield env
    env.close()


def test_the_environment_keeps_torchrl_s_rules(env):
    check_env_specs(env)
    assert (env.tasks, env.max_steps, env.action_spec.shape) == (BOTH, 160, (4, 9))
    torch.manual_seed(0)
    rollout = env.rollout(3)
    assert rollout["observation"].shape == (4, 3, 93)
    first = env.reset(episode=2)["observation"]
    assert torch.equal(first, env.reset(episode=2)["observation"])
    assert not torch.equal(first, env.reset(episode=3)["observation"])


def test_the_first_59_numbers_are_the_kitchen_s_own():
    theirs = KitchenEnv(tasks_to_complete=["microwave"])
    ours = KitchenEngine([*BOTH, "kitchen/microwave"])
    states = ours.reset([0, 1, 2], [5, 6, 7])
    expected = theirs.reset(seed=7)[0]["observation"]
    assert np.array_equal(states[2, :59], expected)
    draws = np.random.default_rng(0)
    for _ in range(3):
        action = draws.uniform(-1, 1, (3, 9))
        step = ours.step(action, np.array([True, False, True]))
        assert np.array_equal(step.observation[2, :59], theirs.step(action[2])[0]["observation"])
        assert np.array_equal(step.observation[1], states[1])
    assert np.abs(states[0, KITCHEN.positions[-1]] - states[0, [78, 79, 80]]).max() > 0.1  # the door's goal is open
    theirs.close()
    ours.close()


def test_what_is_open_is_the_simulator_s_success():
    engine = KitchenEngine(BOTH)
    engine.reset([0, 1], [1, 2])
    program = lw.QueryProgram(
        {task: [f"the {task.name[8:].replace('-', ' ')} is open"] for task in (MICROWAVE, CABINET)}
    )
    ids = torch.tensor([lw.task_id(task) for task in BOTH])
    still, all_rows = np.zeros((2, 9)), np.ones(2, bool)
    before = engine.step(still, all_rows)
    assert not before.success.any()
    assert not program(torch.from_numpy(before.observation), ids).any()
    engine._rows[0].data.qpos[22] = -0.75
    engine._rows[1].data.qpos[19] = 0.37
    after = engine.step(still, all_rows)
    assert after.success.all()
    assert after.reward.tolist() == [1.0, 1.0]
    assert program(torch.from_numpy(after.observation), ids).all()
    engine.close()


def test_the_check_finds_nothing_wrong_and_names_an_opening_that_is_no_share():
    found = check_suite(SUITE)
    assert all(one.right for one in found)
    assert "opening of the microwave" in {one.what for one in found}
    angle = tuple(replace(one, opening=3) if one.name == "microwave" else one for one in MICROWAVE.objects)
    wrong = replace(SUITE, tasks={MICROWAVE.name: replace(MICROWAVE, objects=angle)}, plans=None)
    assert [one.what for one in check_suite(wrong) if not one.right] == ["opening of the microwave"]


shares = st.floats(0.0, 1.0, width=32)


@given(st.lists(st.lists(shares, min_size=6, max_size=6), min_size=1, max_size=5), st.sampled_from(JOINTED))
def test_open_and_closed_are_the_published_ones_of_a_thing_s_own_number(openings, thing):
    state = torch.zeros(len(openings), 93)
    state[:, 84:90] = torch.tensor(openings)
    ids = torch.full((len(openings),), lw.task_id(MICROWAVE.name))
    asked = [
        f"the {thing} is open",
        f"is the {thing} closed?",
        f"the {thing} isn't open and the kettle is near the gripper",
    ]
    program = lw.QueryProgram({MICROWAVE: asked})
    share = state[:, 84 + JOINTED.index(thing)]
    expected = torch.stack((share > 0.75, share <= 0.75, share <= 0.75), -1)
    assert torch.equal(program(state, ids), expected)
    logits = program.logits(state, ids)
    assert torch.equal(logits > 0, expected)
    gripper = state.clone()
    gripper[:, KITCHEN.opening] = share
    same = lw.QueryProgram({MICROWAVE: ["the gripper is open"]})
    assert torch.equal(same.logits(gripper, ids)[:, 0], logits[:, 0])


def test_a_word_of_one_s_own_is_said_of_what_has_an_opening(monkeypatch):
    with pytest.raises(lw.QueryError, match=r"expected one of .*'open', 'closed'"):
        lw.parse_query("the light switch is on", MICROWAVE)
    monkeypatch.setitem(STATES, "on", STATES["open"])
    monkeypatch.setitem(
        STATES, "ajar", (Comparison("z", ">", 0.1, length=False), Comparison("z", "<=", 0.75, length=False))
    )
    assert str(lw.parse_query("Is the light switch not on?", MICROWAVE)) == "the light switch is not on"
    assert "the microwave is ajar" in lw.supported_queries(MICROWAVE)
    assert "the robot's gripper is ajar" not in lw.supported_queries(MICROWAVE)
    assert not any("microwave is" in query and "open" in query for query in lw.supported_queries(MICROWAVE, True))
    state = torch.zeros(4, 93)
    state[:, DOOR] = torch.tensor([0.05, 0.5, 0.75, 0.8])
    program = lw.QueryProgram(
        {MICROWAVE: ["the microwave is ajar", "the microwave is on and the light switch is not on"]}
    )
    found = program(state, torch.full((4,), lw.task_id(MICROWAVE.name)))
    assert found.T.tolist() == [[False, True, True, False], [False, False, False, True]]
    with pytest.raises(lw.QueryError, match=r"the kettle; only the robot's gripper and .* can be open or closed or on"):
        lw.parse_query("the kettle is on", MICROWAVE)
    with pytest.raises(lw.QueryError, match="only the robot's gripper can be"):
        lw.parse_query("the puck is ajar", "push")


@pytest.mark.parametrize(
    ("name", "parts", "says"),
    [
        ("near", STATES["open"], "may not be named 'near'"),
        ("touching the table", STATES["open"], "may not be named"),
        ("on", (Comparison("x", ">", 0.5, length=False),), "must compare the opening, .*got Comparison"),
        ("on", (Comparison("z", ">", 0.5),), "must compare the opening"),
        ("on", Comparison("z", ">", 0.5, length=False), "must be a tuple of Comparison"),
    ],
)
def test_what_is_no_state_is_refused(name, parts, says):
    with pytest.raises(ValueError, match=says):
        STATES[name] = parts
    assert [*STATES] == ["open", "closed"]
    assert [*PREDICATES][-3:] == ["touching the table", "open", "closed"]


def test_openings_are_written_and_checked():
    assert MICROWAVE.to_json()["objects"]["microwave"] == {"position": "obs[78:81]", "opening": f"obs[{DOOR}]"}
    assert lw.Task.from_json(MICROWAVE.name, MICROWAVE.to_json()) == MICROWAVE
    for opening, says in (
        (93, r"obs\[93\] is outside the 93 numbers"),
        (0.5, "must be an index"),
        (True, "must be an index"),
    ):
        with pytest.raises(ValueError, match=says):
            replace(MICROWAVE, objects=(*MICROWAVE.objects, NamedObject("drawer", (0, 1, 2), opening=opening)))
    for at in ({"opening": "obs[3]"}, {"position": "obs[0:3]"}, {"position": "obs[0:3]", "opening": 3}):
        with pytest.raises(ValueError, match="object 'door' must have a position and an opening like"):
            lw.Task.from_json("mine", {"description": "Mine.", "objects": {"door": at}})
    with pytest.raises(ValueError, match=r"key of object 'door' must be one of .*did you mean 'opening'"):
        lw.Task.from_json("mine", {"description": "Mine.", "objects": {"door": {"openin": "obs[3]"}}})


def test_plans_about_openings_are_read_from_every_format():
    plan = PLANS[MICROWAVE.name]
    for name in lw.PLAN_FORMATS:
        found = lw.decode_plan(lw.encode_plan(plan, name), MICROWAVE, format=name)
        assert [str(step.condition) for step in found.plan.steps] == [str(step.condition) for step in plan.steps]


def actors(features):
    yield lw.PlanConditionedActor(PLANS, features=features, roles=features == "opening", **SMALL)
    if features != "opening":
        yield lw.DescriptorConditionedActor([MICROWAVE, CABINET], features=features, **SMALL)


@pytest.mark.parametrize("features", ["raw", "differences", "relative", "opening", "both"])
def test_actors_give_nine_numbers(features, env, tmp_path):
    state = env.reset()
    for actor in actors(features):
        assert actor.eval()(state.clone())["action"].shape == (4, 9)
        lw.save_actor(actor, tmp_path / "actor.zip")
        again = lw.load_actor(tmp_path / "actor.zip", text_encoder=letters).eval()
        assert again.layout == KITCHEN
        assert torch.equal(again(state.clone())["action"], actor(state.clone())["action"])


def test_an_evaluator_reads_a_thing_s_opening():
    evaluator = lw.StateQueryEvaluator(PLANS, width=8)
    state = torch.zeros(2, 93)
    state[1, DOOR] = 1.0
    ids = torch.full((2,), lw.task_id(MICROWAVE.name))
    logits = evaluator.logits(state, ids)
    assert not torch.equal(logits[0, 2], logits[1, 2])


def test_what_needs_a_displacement_says_so():
    go = ScriptedSkill("go there", "microwave")
    plan = lw.ConditionalPlan.from_pairs(MICROWAVE, [("the microwave is closed", go.text)])
    says = "an action of layout 'kitchen' has no displacement of the hand"
    with pytest.raises(ValueError, match=f"scripted skills: {says}"):
        lw.ScriptedSkillActor(lw.Plans([plan]), skills={go.text: go})
    with pytest.raises(ValueError, match=f"RandomYaw: {says}"):
        lw.RandomYaw(0.3, plans=PLANS)
    trained = lw.PlanConditionedActor(lw.load_plans("MT10"), roles=True, features="opening", text_encoder=letters)
    with pytest.raises(ValueError, match=f"TransferredActor: {says}"):
        lw.modules.TransferredActor(trained, PLANS)


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    root = tmp_path_factory.mktemp("kitchen") / "demos"
    return lw.collect_demonstrations(
        "kitchen/slide-cabinet", suite=SUITE, policy=Pusher(), behaviour="pusher", episodes_per_task=3,
        noise_scale=(0.0, 0.1), root=root, progress=False,
    )  # fmt: skip


@pytest.fixture
def replay(demos):
    """Of the demonstrations' own actions; 64 a batch."""
    return lw.LanguageWorldExperienceReplay(
        demos.root, label="executed", batch_size=64, transform=lw.QAFTransform(PLANS), seed=0
    )


@pytest.mark.slow
def test_a_policy_learns_from_demonstrations_and_acts(demos, replay):
    assert demos.success_rate == {CABINET.name: 1.0}
    for actor in actors("both"):
        torch.manual_seed(0)
        config = lw.BehavioralCloningConfig(steps=600, batch_size=64, learning_rate=1e-3)
        trainer = lw.BehavioralCloningTrainer(actor, replay, config, progress=False)
        before, after = trainer.train(100), trainer.train()
        assert after < 0.5 * before
        run = {"tasks": "slide-cabinet", "suite": SUITE, "episodes_per_task": 2, "seed": 1_000, "noise_scale": 0.0}
        print(type(actor).__name__, before, after, lw.evaluate(actor, **run, progress=False).success_once)


@pytest.mark.slow
def test_torchrl_s_losses_step(replay):
    actor = lw.PlanConditionedActor(PLANS, **SMALL)
    qvalue = lw.PlanConditionedQValue(PLANS, **SMALL)
    loss = TD3Loss(actor, qvalue, bounds=(-1.0, 1.0))
    loss.make_value_estimator(gamma=0.9)
    optimizer = torch.optim.AdamW(loss.parameters(), lr=1e-3)
    before = {name: value.clone() for name, value in loss.named_parameters()}
    for _ in range(2):
        batch = replay.sample()
        batch["next", "reward"] = batch["next", "success"].float()
        found = loss(batch)
        optimizer.zero_grad()
        (found["loss_actor"] + found["loss_qvalue"]).backward()
        optimizer.step()
    assert all(value.isfinite().all() for value in loss.parameters())
    moved = {name.partition(".")[0] for name, value in loss.named_parameters() if not torch.equal(value, before[name])}
    assert {"actor_network_params", "qvalue_network_params"} <= moved


@pytest.mark.slow
def test_a_recording_shows_the_kitchen_as_it_moved(tmp_path):
    actor = lw.PlanConditionedActor(PLANS, **SMALL)
    (one,) = run_recorded(actor, "kitchen/microwave", suite=SUITE, seed=7, max_steps=10)
    with lw.RerunLogger(tmp_path / "kitchen.rrd") as logger:
        assert lw.log_rollout(logger, one.steps, PLANS, seed=7, suite=SUITE) == "kitchen/microwave-0"
    entities = [chunk.entity_path for chunk in RrdReader(tmp_path / "kitchen.rrd").stream()]
    print(sorted(set(entities))[:400])
