"""A custom suite works wherever Meta-World does: environment, data, training, files, evaluation, recordings."""

import pickle
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from torchrl.envs import Compose, TransformedEnv, check_env_specs
from toy_suite import SKILLS, TASKS, TOY, ToyEngine, make_toy_suite

import lw_torchrl as lw
from lw_torchrl.language.layout import METAWORLD
from lw_torchrl.language.skills import ScriptedSkill, load_skills
from lw_torchrl.modules import Concat, ObservationFeatures, RoleFeatures, TransferredActor, transform_of
from lw_torchrl.record.verdict import action_names
from lw_torchrl.suites import SUITES, Suite, check_suite, find_suite, load_suite

SUITE = make_toy_suite()
CANONICAL = lw.canonical_plans(SUITE.plans)


def small(actions=7):
    return {
        "skill_encoder": lw.modules.SkillEncoder(4, width=8),
        "decoder": lw.modules.MLPDecoder(width=16, depth=1, actions=actions),
    }


def role_actor(plans, actions=7):
    """A policy on the roles of the steps and the opening of the gripper."""
    plans = lw.canonical_plans(plans)
    features = Concat(ObservationFeatures("opening", layout=plans.layout), RoleFeatures(plans))
    return lw.PlanConditionedActor(plans, features=features, **small(actions))


def pressing(task):
    """A plan of motions with a purpose, which "move the gripper to the block" lacks."""
    block = task.object_names[1]
    steps = [("not near", "lower the gripper onto"), ("near", "press")]
    return lw.ConditionalPlan.from_pairs(
        task, [(f"the gripper is {relation} the {block}", f"{words} the {block}") for relation, words in steps]
    )


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    root, tasks = tmp_path_factory.mktemp("toy") / "demos", ["touch-red", "toy/touch-blue"]
    return lw.collect_demonstrations(tasks, suite=SUITE, episodes_per_task=3, root=root, progress=False)


def test_environment_follows_torchrls_rules():
    env = lw.LanguageWorldEnv("toy", suite=SUITE, num_envs=4)
    assert (env.tasks, env.max_steps, env.layout) == (("toy/touch-blue", "toy/touch-red"), 30, TOY)
    check_env_specs(env)
    assert TransformedEnv(env, lw.QAFTransform(SUITE.plans)).rollout(3)["qaf"].shape == (4, 3, 2)
    assert torch.equal(env.reset(episode=2)["observation"], env.reset(episode=2)["observation"])


def test_scripted_plans_demonstrate_and_datasets_keep_the_layout(demos):
    assert demos.success_rate == {"toy/touch-blue": 1.0, "toy/touch-red": 1.0}
    replay = lw.LanguageWorldExperienceReplay(demos.root, transform=lw.QAFTransform(SUITE.plans))
    sample = replay.sample(8)
    assert (sample["observation"].shape, sample["action"].shape) == ((8, 16), (8, 7))
    assert replay.demonstrations.config.layout == TOY
    run = {"suite": SUITE, "episodes_per_task": 3, "root": demos.root, "progress": False}
    assert lw.collect_demonstrations("toy", **run).episodes == demos.episodes, "read, not collected again"


def test_named_behaviours_follow_the_suites_plans(tmp_path):
    run = {"suite": SUITE, "episodes_per_task": 1, "redraw_failures": False, "progress": False}
    plain, chance = (
        lw.collect_demonstrations("toy", policy=who, root=tmp_path / who, **run) for who in ("scripted", "random")
    )
    assert plain.success_rate == {"toy/touch-blue": 1.0, "toy/touch-red": 1.0}
    assert lw.LanguageWorldExperienceReplay(chance.root, label="executed")[:]["action"].shape == (60, 7)
    bare = replace(SUITE, plans=None)
    with pytest.raises(ValueError, match="suite 'toy' has no plans"):
        lw.collect_demonstrations("toy", policy="random", root=tmp_path / "bare", **run | {"suite": bare})


@pytest.mark.parametrize("features", ["raw", "differences", "relative", "both"])
def test_features_have_the_layouts_width(features, demos):
    plans = SUITE.plans
    transform = Compose(lw.QAFTransform(plans), lw.transforms.SwapUnmentioned(plans, 0.5))
    replay = lw.LanguageWorldExperienceReplay(demos.root, transform=transform)
    observed = ObservationFeatures(features, layout=TOY)
    actor = lw.PlanConditionedActor(plans, features=Concat(observed, lw.modules.FocusFeatures(plans)), **small())
    config = lw.BehavioralCloningConfig(steps=2, batch_size=8)
    lw.BehavioralCloningTrainer(actor, replay, config, progress=False).train()
    pairs = 10  # of hand, three blocks and goal
    widths = {"raw": 16, "relative": 9 * pairs, "differences": 9 * pairs + 2, "both": 16 + 9 * pairs + 2}
    assert (observed.width, actor.spec["action"].shape) == (widths[features], (7,))


def test_policy_is_trained_saved_evaluated_and_recorded(demos, tmp_path):
    actor = role_actor(lw.Plans([pressing(task) for task in TASKS.values()]))
    transform = Compose(transform_of(actor), lw.RandomYaw(0.3, plans=actor.plans))
    replay = lw.LanguageWorldExperienceReplay(demos.root, sampler=lw.TaskBalancedSampler(), transform=transform)
    config = lw.BehavioralCloningConfig(steps=300, batch_size=60, learning_rate=1e-2)
    lw.BehavioralCloningTrainer(actor, replay, config, progress=False).train()
    lw.save_actor(actor, tmp_path / "toy.safetensors")
    again = lw.load_actor(tmp_path / "toy.safetensors")
    run = {"tasks": "toy", "suite": SUITE, "episodes_per_task": 4, "seed": 1_000, "progress": False}
    episodes, keys = [], ["observation", "task_id", "qaf", "skill_weights"]
    result = lw.evaluate(again, **run, also_record=keys, on_episode=episodes.append)
    assert result.mean_success > 0.7
    result.save(tmp_path / "results.json")
    assert lw.EvaluationResult.load(tmp_path / "results.json").episodes == result.episodes
    steps = episodes[0].steps
    steps["episode"] = torch.full((len(steps),), episodes[0].episode)
    with lw.RerunLogger(tmp_path / "toy.rrd") as logger:
        assert lw.log_rollout(logger, steps, again.plans, seed=1_000, suite=SUITE).startswith("toy")


def test_recording_names_the_layouts_actions_and_needs_no_plan(tmp_path):
    env = lw.LanguageWorldEnv("toy", suite=SUITE)
    rollout = env.rollout(3, auto_reset=True)[0]
    with lw.RerunLogger(tmp_path / "toy.rrd") as logger:
        assert lw.log_rollout(logger, rollout, seed=env.seed, suite=SUITE).startswith("toy")
    env.close()
    assert action_names(TOY) == ["0", "dx", "dy", "dz", "4", "5", "gripper"]


def test_failures_are_attributed_with_the_suites_skills():
    shifted = {text: ScriptedSkill(text, skill.target, offset=(0.1, 0.0, 0.0)) for text, skill in SKILLS.items()}
    run = {"tasks": "toy/touch-red", "suite": SUITE, "episodes_per_task": 2, "seed": 7, "progress": False}
    result = lw.evaluate(lw.ScriptedSkillActor(SUITE.plans, skills=shifted), attribute=True, **run)
    assert [failure.cause for failure in result.failures] == ["skill", "skill"]


def test_metaworld_policy_acts_in_the_suite_and_is_saved(tmp_path):
    """The policy is not trained: only sizes, units and signs are tested."""
    trained = role_actor(lw.load_plans("MT10"), 4).eval()
    moved = TransferredActor(lw.modules.ActorEnsemble([trained, trained]), CANONICAL)
    converted = moved.converted(torch.tensor([[0.5, -1.0, 0.2, 0.7], [0.0, 0.0, 0.0, 0.2]]))
    torch.testing.assert_close(converted[0], torch.tensor([0.0, 0.5, -1.0, 0.2, 0.0, 0.0, -1.0]))
    assert converted[1, 6] == 1.0  # efforts below 0.3 open the gripper, and here -1 closes
    result = lw.evaluate(moved, tasks="toy", suite=SUITE, episodes_per_task=1, seed=3, progress=False)
    assert set(result.success_once) == set(TASKS)
    faster = TransferredActor(trained, CANONICAL, speed=6.0)
    lw.save_actor(faster, tmp_path / "moved.safetensors")
    again = lw.load_actor(tmp_path / "moved.safetensors").eval()
    assert (again.layout, again.trained, again.speed) == (TOY, METAWORLD, 6.0)
    action = again.converted(torch.tensor([0.5, -1.0, 0.2, 0.7]))
    torch.testing.assert_close(action, torch.tensor([0.0, 0.6, -1.0, 0.24, 0.0, 0.0, -1.0]))
    state = transform_of(again)(lw.LanguageWorldEnv("toy", suite=SUITE).reset())
    assert torch.equal(again(state.clone())["action"], faster(state.clone())["action"])


def test_suites_are_found_by_name(monkeypatch):
    monkeypatch.setitem(SUITES, "toy", SUITE)
    assert find_suite(["toy/touch-red"]) is load_suite("toy") is SUITE
    env = lw.LanguageWorldEnv("toy/touch-red")
    assert env.suite is SUITE
    env.close()
    with pytest.raises(ValueError, match=r"^suite .*'toi'; did you mean 'toy'"):
        lw.LanguageWorldEnv("toi/touch-red")
    with pytest.raises(ValueError, match="did you mean 'toy/touch-red'"):
        lw.LanguageWorldEnv("toy/touch-rad")


class Broken(ToyEngine):
    """A toy with one fault."""

    fault = ""

    def _broken(self, seen):
        if self.fault == "NaN":
            seen[:, 10] = np.nan
        elif self.fault == "floor":
            seen[:, [3, 6, 9, 12, 15]] += 0.42
        elif self.fault == "objects from the hand":
            seen[:, 4:13] = np.tile(seen[:, 1:4], 3) - seen[:, 4:13]
        elif self.fault == "high":
            seen[:, 6] = 0.025
        elif self.fault == "no past":
            seen = np.pad(seen, ((0, 0), (0, 13)))
        return seen.astype(np.float32) if self.fault == "single" else seen

    def reset(self, rows, seeds):
        seen = self._broken(super().reset(rows, seeds))
        return np.tile(seen, (2, 1))[:2] if self.fault == "all rows" else seen

    def step(self, action, active):
        if self.fault == "plane":
            action = action * (np.arange(7) != 3)
        done = super().step(action, np.ones_like(active) if self.fault == "restless" else active)
        if self.fault == "restless":
            self.state[1, 1] += 0.01
        done = done._replace(observation=self._broken(done.observation))
        if self.fault == "always success":
            done = done._replace(success=np.ones_like(done.success))
        return tuple(done) if self.fault == "tuple" else done


def findings_of(suite, right=False):
    """Return the measurements of check_suite that are wrong, or right, or unclear (None)."""
    return {finding.what: finding.measured for finding in check_suite(suite) if finding.right is right}


def test_check_finds_nothing_wrong_in_the_toy():
    assert findings_of(SUITE) == findings_of(SUITE, None) == {}


@pytest.mark.parametrize(
    ("fault", "what", "right"),
    [
        ("NaN", "observation values", False),
        ("floor", "the lowest object or hand", False),
        ("objects from the hand", "object 1 as the hand moves", False),
        ("single", "observations after a reset", False),
        ("all rows", "a reset of one of two rows", False),
        ("restless", "an inactive row", False),
        ("tuple", "a step", False),
        ("always success", "success while the hand rests for 30 steps", False),
        ("high", "object 1 rests at", None),
    ],
)
def test_check_finds_a_broken_engine(fault, what, right, monkeypatch):
    monkeypatch.setattr(Broken, "fault", fault)
    assert what in findings_of(make_toy_suite(Broken), right)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"inertia": 0.9}, {"the hand stops after": "5.7 steps"}),
        ({"closing": 0.05}, {"steps to close": "18"}),
        ({"reach": 0.02}, dict.fromkeys(["+x moves right", "+y moves away from the robot", "+z moves up"])),
    ],
    ids=str,
)
def test_check_measures_the_hand_and_the_gripper(options, expected):
    wrong = findings_of(make_toy_suite(partial(ToyEngine, **options)))
    assert wrong.keys() >= expected.keys()
    assert all(wrong[what] == measured for what, measured in expected.items() if measured)


def test_check_accepts_a_hand_that_stays_in_a_plane(monkeypatch):
    monkeypatch.setattr(Broken, "fault", "plane")
    suite = make_toy_suite(Broken)
    assert findings_of(suite) == findings_of(suite, None) == {}
    assert findings_of(suite, True)["+z moves up"] == "nothing: the hand stays in a plane"


GRIPPER_PAIRS = [("the gripper is open", "go"), ("the gripper is closed", "stay")]


@pytest.mark.parametrize(
    ("fault", "change", "pairs", "wrong"),
    [
        ("no past", {"size": 29, "past": 13, "goal": 26}, None, {"values of the previous step"}),
        ("", {"gripper": 5}, None, set()),
        ("", {"gripper": 5}, GRIPPER_PAIRS, {"gripper"}),
    ],
    ids=["a past that is zero", "a gripper that does not move", "a gripper that the plan moves"],
)
def test_check_compares_the_layout_with_the_engine(fault, change, pairs, wrong, monkeypatch):
    monkeypatch.setattr(Broken, "fault", fault)
    layout = replace(TOY, **change)
    tasks = {name: replace(task, layout=layout) for name, task in TASKS.items()}
    plans = pairs and lw.Plans([lw.ConditionalPlan.from_pairs(tasks["toy/touch-red"], pairs)])
    assert findings_of(Suite("toy", layout, tasks, Broken, plans=plans)).keys() == wrong


@pytest.mark.parametrize("suite", ["metaworld", "fetch"])
def test_suites_and_tables_are_pickled_and_read_only(suite):
    suite = load_suite(suite)
    copy = pickle.loads(pickle.dumps(suite))
    assert (copy.tasks, copy.skills, copy.layout) == (suite.tasks, suite.skills, suite.layout)
    assert copy.plans.fingerprint == suite.plans.fingerprint
    for table in (lw.TASKS, load_skills(), suite.tasks, suite.skills):
        assert pickle.loads(pickle.dumps(table)) == table
        with pytest.raises(TypeError, match="does not support item assignment"):
            table["new"] = table[min(table)]


@pytest.mark.parametrize(("number", "right"), [(0, True), (5, False)])
def test_openings_are_checked_and_answered_in_a_suite_whose_actions_move_joints(number, right):
    """Number 0 is between 0 and 1, number 5 a position."""
    red = TASKS["toy/touch-red"]
    objects = (red.objects[0], replace(red.objects[1], opening=number))
    red = replace(red, objects=objects, layout=replace(TOY, displacement=None, gripper=None))
    suite = Suite("toy", red.layout, {red.name: red}, ToyEngine)
    assert "opening of the red block" in findings_of(suite, right)
    assert right is False or findings_of(suite) == {}
    state, ids = torch.zeros(2, TOY.size), torch.full((2,), lw.task_id(red.name))
    state[1, number] = 1.0
    assert lw.QueryProgram({red: ["the red block is open"]})(state, ids).tolist() == [[False], [True]]
    plans = lw.Plans([lw.ConditionalPlan.from_pairs(red, [("the red block is open", "stay")])])
    logits = lw.modules.StateQueryEvaluator(plans, width=8).logits(state, ids)
    assert not torch.equal(logits[0], logits[1])
