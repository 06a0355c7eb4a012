"""A custom suite with another robot, whose actions move joints, and objects that open, turn and slide."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from rerun.chunk import RrdReader
from torchrl.envs import TransformedEnv, check_env_specs

import lw_torchrl as lw
from lw_torchrl.cli.main import main
from lw_torchrl.language.skills import ScriptedSkill
from lw_torchrl.modules import Concat, MLPDecoder, ObservationFeatures, RoleFeatures, SkillEncoder, transform_of
from lw_torchrl.record.rollouts import run_recorded
from lw_torchrl.suites import check_suite

pytest.importorskip("gymnasium_robotics")
from gymnasium_robotics.envs.franka_kitchen.kitchen_env import OBS_ELEMENT_GOALS, OBS_ELEMENT_INDICES, KitchenEnv
from kitchen_suite import CABINET, JOINTED, KITCHEN, MICROWAVE, PLANS, KitchenEngine, Pusher, make_suite

SUITE = make_suite()
BOTH = ("kitchen/microwave", "kitchen/slide-cabinet")
DOOR = MICROWAVE.openings["microwave"]


def letters(texts):
    return torch.tensor([[float(text.count(letter)) for letter in "aeioust"] for text in texts])


def small(kind="differences", encoder="skill_encoder", actions=9):
    """The parts of a small actor, whose skill texts are counted letters."""
    return {
        "features": ObservationFeatures(kind, layout=KITCHEN, noise=0.05),
        encoder: SkillEncoder(4),
        "decoder": MLPDecoder(width=32, depth=1, actions=actions),
        "text_encoder": letters,
    }


@pytest.fixture
def env():
    env = TransformedEnv(lw.LanguageWorldEnv("kitchen", suite=SUITE, num_envs=4), lw.QAFTransform(PLANS))
    yield env
    env.close()


def test_environment_follows_torchrls_rules(env):
    check_env_specs(env)
    assert (env.tasks, env.max_steps, env.action_spec.shape) == (BOTH, 160, (4, 9))
    torch.manual_seed(0)
    rollout = env.rollout(3)
    assert rollout["observation"].shape == (4, 3, 93)
    first = env.reset(episode=2)["observation"]
    assert torch.equal(first, env.reset(episode=2)["observation"])
    assert not torch.equal(first, env.reset(episode=3)["observation"])


def test_first_59_numbers_are_the_kitchens():
    original = KitchenEnv(tasks_to_complete=["microwave"])
    engine = KitchenEngine([*BOTH, "kitchen/microwave"])
    states = engine.reset([0, 1, 2], [5, 6, 7])
    expected = original.reset(seed=7)[0]["observation"]
    assert np.array_equal(states[2, :59], expected)
    draws = np.random.default_rng(0)
    for _ in range(3):
        action = draws.uniform(-1, 1, (3, 9))
        step = engine.step(action, np.array([True, False, True]))
        assert np.array_equal(step.observation[2, :59], original.step(action[2])[0]["observation"])
        assert np.array_equal(step.observation[1], states[1])
    assert np.abs(states[0, KITCHEN.positions[-1]] - states[0, [78, 79, 80]]).max() > 0.1  # the door's goal is open
    original.close()
    engine.close()


def test_all_seven_objects_succeed_and_openings_are_right():
    engine = KitchenEngine([f"kitchen/{thing.replace(' ', '-')}" for thing in OBS_ELEMENT_GOALS])
    rows = list(range(len(OBS_ELEMENT_GOALS)))
    engine.reset(rows, rows)
    program = lw.QueryProgram({MICROWAVE: [f"the {thing} is open" for thing in JOINTED]})
    ids = torch.full((len(rows),), lw.task_id(MICROWAVE.name))
    still, every_row = np.zeros((len(rows), 9)), np.ones(len(rows), bool)
    before = engine.step(still, every_row)
    assert not before.success.any()
    assert not program(torch.from_numpy(before.observation), ids).any()
    for row, (thing, goal) in enumerate(OBS_ELEMENT_GOALS.items()):
        engine._rows[row].data.qpos[OBS_ELEMENT_INDICES[thing]] = goal
    after = engine.step(still, every_row)
    assert after.success.all()
    assert after.reward.tolist() == [1.0] * len(rows)
    opened = [[jointed == thing for jointed in JOINTED] for thing in OBS_ELEMENT_GOALS]
    assert program(torch.from_numpy(after.observation), ids).tolist() == opened
    engine.close()


def test_check_finds_nothing_wrong_but_an_opening_outside_its_range():
    findings = check_suite(SUITE)
    assert all(finding.right for finding in findings)
    assert "opening of the microwave" in {finding.what for finding in findings}
    objects = tuple(replace(thing, opening=3) if thing.name == "microwave" else thing for thing in MICROWAVE.objects)
    wrong = replace(SUITE, tasks={MICROWAVE.name: replace(MICROWAVE, objects=objects)}, plans=None)
    assert [finding.what for finding in check_suite(wrong) if not finding.right] == ["opening of the microwave"]


def test_plans_about_openings_survive_every_format():
    plan = PLANS[MICROWAVE.name]
    for name in lw.PLAN_FORMATS:
        decoded = lw.decode_plan(lw.encode_plan(plan, name), MICROWAVE, format=name).plan
        assert [str(step.condition) for step in decoded.steps] == [str(step.condition) for step in plan.steps]


def actors(features):
    yield lw.PlanConditionedActor(PLANS, **small(features))
    if features == "opening":
        plans = lw.canonical_plans(PLANS)
        yield lw.PlanConditionedActor(
            plans, **small() | {"features": Concat(ObservationFeatures("opening", layout=KITCHEN), RoleFeatures(plans))}
        )
    else:
        yield lw.modules.DescriptorConditionedActor([MICROWAVE, CABINET], **small(features, "task_encoder"))


@pytest.mark.parametrize("features", ["raw", "differences", "relative", "opening", "both"])
def test_actors_write_nine_numbers(features, env, tmp_path):
    for actor in actors(features):
        state = env.reset()
        state = state if actor.plans is None else transform_of(actor)(state)
        assert actor.eval()(state.clone())["action"].shape == (4, 9)
        lw.save_actor(actor, tmp_path / "actor.safetensors")
        again = lw.load_actor(tmp_path / "actor.safetensors", text_encoder=letters).eval()
        assert again.layout == KITCHEN
        assert torch.equal(again(state.clone())["action"], actor(state.clone())["action"])


def test_evaluator_reads_an_objects_opening():
    evaluator = lw.modules.StateQueryEvaluator(PLANS, width=8)
    state = torch.zeros(2, 93)
    state[1, DOOR] = 1.0
    ids = torch.full((2,), lw.task_id(MICROWAVE.name))
    logits = evaluator.logits(state, ids)
    assert not torch.equal(logits[0, 2], logits[1, 2])


def test_errors_where_a_displacement_is_needed():
    go = ScriptedSkill("go there", "microwave")
    plan = lw.ConditionalPlan.from_pairs(MICROWAVE, [("the microwave is closed", go.text)])
    missing = "displacement of the hand, got layout 'kitchen'"
    with pytest.raises(ValueError, match=f"scripted skills: .*{missing}"):
        lw.ScriptedSkillActor(lw.Plans([plan]), skills={go.text: go})
    with pytest.raises(ValueError, match=f"RandomYaw: .*{missing}"):
        lw.RandomYaw(0.3, plans=PLANS)
    plans = lw.canonical_plans(lw.load_plans("MT10"))
    trained = lw.PlanConditionedActor(plans, features=RoleFeatures(plans))
    with pytest.raises(ValueError, match=f"TransferredActor: .*{missing}"):
        lw.modules.TransferredActor(trained, lw.canonical_plans(PLANS))


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    root = tmp_path_factory.mktemp("kitchen") / "demos"
    return lw.collect_demonstrations(
        "kitchen/slide-cabinet", suite=SUITE, policy=Pusher(), behaviour="pusher", episodes_per_task=3,
        noise_scale=(0.0, 0.1), root=root, progress=False,
    )  # fmt: skip


@pytest.fixture
def replay(demos):
    return lw.LanguageWorldExperienceReplay(
        demos.root, label="executed", batch_size=64, transform=lw.QAFTransform(PLANS)
    )


@pytest.mark.slow
def test_policy_learns_from_demonstrations_and_acts(demos, replay):
    assert demos.success_rate == {CABINET.name: 1.0}
    torch.manual_seed(0)
    for actor in actors("both"):
        config = lw.BehavioralCloningConfig(steps=600, batch_size=64, learning_rate=1e-3)
        trainer = lw.BehavioralCloningTrainer(actor, replay, config, progress=False)
        before, after = trainer.train(100), trainer.train()
        assert after < 0.25 * before
        run = {"tasks": "slide-cabinet", "suite": SUITE, "episodes_per_task": 10, "seed": 1_000, "noise_scale": 0.0}
        assert lw.evaluate(actor, **run, progress=False).mean_success >= 0.9


def places_of_bodies(chunks, scene):
    """Return the first position of each body that a recording moves, by the end of its frame's name."""
    places = {}
    for batch in (chunk.to_record_batch() for chunk in chunks if chunk.entity_path == f"{scene}/bodies"):
        named, placed = (batch.column(f"Transform3D:{part}").to_pylist() for part in ("child_frame", "translation"))
        for name, place in zip(named, placed, strict=True):
            places.setdefault(name[0].rpartition("/")[2], place[0])
    return places


@pytest.mark.slow
def test_recording_shows_the_kitchens_movements(tmp_path):
    actor = lw.PlanConditionedActor(PLANS, **small())
    (episode,) = run_recorded(actor, "kitchen/microwave", suite=SUITE, seed=7, max_steps=10)
    with lw.RerunLogger(tmp_path / "kitchen.rrd") as logger:
        assert lw.log_rollout(logger, episode.steps, PLANS, seed=7, suite=SUITE) == "kitchen/microwave-0"
    chunks = list(RrdReader(tmp_path / "kitchen.rrd").stream())
    scene = r"/kitchen\/microwave-0/scene"
    entities = {chunk.entity_path for chunk in chunks}
    bodies = places_of_bodies(chunks, scene)
    assert {"microdoorroot", "panda0_link7", "kettle"} <= bodies.keys()
    assert {f"{scene}/objects/microwave", r"/kitchen\/microwave-0/plan"} <= entities
    assert f"{scene}/gripper" not in entities  # the drawing of an unknown robot
    x, y, z = bodies["kettle"]
    assert (round(x, 2), round(y, 2)) == (-0.27, 0.35)
    assert abs(z) < 0.02  # on the counter, which is our z = 0


@pytest.mark.slow
def test_command_line_evaluates_and_records(tmp_path, capsys):
    lw.save_actor(lw.PlanConditionedActor(PLANS), tmp_path / "kitchen.safetensors")
    where = ["--suite", f"{__name__}:SUITE", "--episodes", "1", "--max-steps", "3", "--out", str(tmp_path / "out")]
    main(["evaluate", str(tmp_path / "kitchen.safetensors"), *where])
    assert "kitchen/slide-cabinet" in capsys.readouterr().out
    chunks = list(RrdReader(tmp_path / "out" / "rollout.rrd").stream())
    assert "panda0_link7" in places_of_bodies(chunks, r"/kitchen\/slide-cabinet-0/scene")
