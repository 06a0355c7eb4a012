"""RandomYaw: positions and actions turn by the same angle, and free motions to a place are also turned in space."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch.nn.functional import normalize, one_hot
from torchrl.envs import Compose

import lw_torchrl as lw
from lw_torchrl.language.layout import METAWORLD, places
from lw_torchrl.language.plans import PlanStep
from lw_torchrl.transforms.random_yaw import random_rotations, turn_observation, turn_vectors

MT10 = lw.load_plans("MT10")
PLACES = [slice(start, start + 2) for start in (0, 4, 11, 18, 22, 29, 36)]


def rows(number=64, seed=0, reach=0.6):
    generator = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.rand(*shape, generator=generator)  # noqa: E731
    return TensorDict({"observation": draw(number, 39), "action": (2 * draw(number, 4) - 1) * reach}, [number])


def wrapped(angles):
    """Return the same angles in [-pi, pi)."""
    return torch.remainder(angles + torch.pi, 2 * torch.pi) - torch.pi


def between(first, second):
    """Return the angle from the first to the second."""
    return wrapped(torch.atan2(second[..., 1], second[..., 0]) - torch.atan2(first[..., 1], first[..., 0]))


@settings(deadline=None, max_examples=40)
@given(scale=st.floats(0.0, 3.0), seed=st.integers(0, 10**6))
def test_positions_and_action_turn_by_the_same_angle_and_keep_their_length(scale, seed):
    was = rows(seed=seed)
    torch.manual_seed(seed)
    now = lw.RandomYaw(scale)(was.clone())
    turned = between(was["action"], now["action"])
    for place in PLACES:
        before, after = was["observation"][:, place], now["observation"][:, place]
        torch.testing.assert_close(after.norm(dim=-1), before.norm(dim=-1))
        assert wrapped(between(before, after) - turned).abs().max() < 1e-3
    torch.testing.assert_close(now["action"].norm(dim=-1), was["action"].norm(dim=-1))


def test_action_outside_the_box_keeps_its_length():
    """Unclipped actions of the scripts, up to 25, are labels that must not be shortened."""
    was = rows(1_000, reach=20.0)
    now = lw.RandomYaw(0.4)(was.clone())
    outside = was["action"][:, :2].abs().amax(-1) > 1
    assert outside.unique().tolist() == [False, True]
    lengths = [td["action"][:, :2].norm(dim=-1)[outside] for td in (was, now)]
    torch.testing.assert_close(*lengths)
    assert now["action"][~outside][:, :2].abs().max() <= 1


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_positions_are_rotated_to_the_bit_as_one_at_a_time(dtype):
    observation, angle = torch.randn(7, 39, dtype=dtype), torch.randn(7)
    expected = observation.clone()
    for x, y, _ in (places(part) for part in METAWORLD.all_positions):
        old_x, old_y = observation[:, x], observation[:, y]
        expected[:, x] = angle.cos() * old_x - angle.sin() * old_y
        expected[:, y] = angle.sin() * old_x + angle.cos() * old_y
    assert torch.equal(turn_observation(observation, angle), expected)


def test_turned_actions_inside_the_box_to_the_bit():
    was = rows(1_000, reach=1.0)
    torch.manual_seed(0)
    now = lw.RandomYaw(0.4)(was.clone())["action"]
    torch.manual_seed(0)
    angle = 0.4 * torch.randn(1_000)
    x, y = was["action"][:, 0], was["action"][:, 1]
    turned = torch.stack([angle.cos() * x - angle.sin() * y, angle.sin() * x + angle.cos() * y], -1)
    turned /= turned.abs().amax(-1, keepdim=True).clamp(min=1.0)
    assert torch.equal(now[:, :2], turned)
    assert torch.equal(now[:, 2:], was["action"][:, 2:])


def test_scale_0_changes_nothing_and_the_seed_fixes_the_angles():
    was = rows()
    assert (lw.RandomYaw(0.0)(was.clone()).exclude("observation_yaw") == was).all()
    result = []
    for seed in (1, 1, 2):
        torch.manual_seed(seed)
        result.append(lw.RandomYaw(0.3)(was.clone())["observation"])
    assert torch.equal(result[0], result[1])
    assert not torch.equal(result[0], result[2])


@pytest.mark.parametrize("times", [1, 2])
def test_written_angles_add_up_and_turn_back(times):
    was = rows()
    was["next", "observation"], now = was["observation"].clone(), was
    for _ in range(times):
        now = lw.RandomYaw(0.5)(now)
    for seen in (now, now["next"]):
        torch.testing.assert_close(turn_observation(seen["observation"], -seen["observation_yaw"]), was["observation"])
    vectors = was["action"][:, [0, 1, 3]]
    torch.testing.assert_close(turn_vectors(vectors, now["observation_yaw"]), now["action"][:, [0, 1, 3]])


ANY_ANGLE = {(1, 0, 0): True, (0, 1, 0): False, (1, 1, 0): False, (1, 0, 1): True, (0, 0, 0): False}


@pytest.mark.parametrize(("truth", "any_angle"), ANY_ANGLE.items())
def test_rows_without_a_direction_are_turned_by_any_angle(truth, any_angle):
    skills = "move the puck to the target location", "push the window handle to the left", "lower the gripper"
    plans = lw.Plans([lw.ConditionalPlan.from_pairs("push", [("gripper is open", skill) for skill in skills])])
    was = rows(2_000, reach=0.5)
    was["qaf"] = torch.tensor(truth, dtype=torch.bool).expand(2_000, 3)
    was["task_id"] = torch.full((2_000,), lw.task_id("push"))
    torch.manual_seed(0)
    now = lw.RandomYaw(0.1, plans=plans)(was)
    turned = between(was["action"], now["action"])
    assert turned.std() == pytest.approx(torch.pi / 3**0.5 if any_angle else 0.1, rel=0.1)
    assert (turned.abs().max() > 3) == any_angle


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    root, options = tmp_path_factory.mktemp("yaw") / "demos", {"max_steps": 60, "noise_scale": 0.2, "progress": False}
    return lw.collect_demonstrations("reach", episodes_per_task=1, root=root, **options).root


def test_all_actions_and_the_next_observation_turn_alike(demos):
    was = lw.LanguageWorldExperienceReplay(demos, label="executed")[:].clone()
    now = lw.RandomYaw(0.7)(was.clone())
    turned = between(was["observation"][:, :2], now["observation"][:, :2])
    for name in ("action", "expert_action", "unclipped_action"):
        moves = was[name][:, :2].norm(dim=-1) > 0.05
        torch.testing.assert_close(between(was[name], now[name])[moves], turned[moves], atol=1e-3, rtol=0)
    after = between(was["next", "observation"][:, :2], now["next", "observation"][:, :2])
    torch.testing.assert_close(after, turned, atol=1e-3, rtol=0)


def test_buffer_answers_on_the_unchanged_scene_and_keeps_its_storage(demos):
    plain = lw.LanguageWorldExperienceReplay(demos, transform=lw.QAFTransform(MT10))
    turned = lw.LanguageWorldExperienceReplay(demos, transform=Compose(lw.QAFTransform(MT10), lw.RandomYaw(1.0)))
    was, now = plain[:], turned[:]
    assert torch.equal(now["qaf"], was["qaf"])
    assert not torch.allclose(now["observation"], was["observation"])
    assert torch.equal(plain[:]["observation"], was["observation"])
    assert not torch.equal(turned[:]["observation"], now["observation"]), "each sample is turned anew"


CANONICAL = lw.canonical_plans(MT10)
NOW = torch.eye(3)


def in_step(task, step, number=400, also=None):
    qaf = torch.zeros(number, CANONICAL.num_steps, dtype=torch.bool)
    qaf[:, [step, step if also is None else also]] = True
    return rows(number, reach=0.5).update({"qaf": qaf, "task_id": torch.full((number,), lw.task_id(task))})


def tilted(was, tilt=1.0, scale=0.0):
    torch.manual_seed(0)
    return lw.RandomYaw(scale, plans=CANONICAL, tilt=tilt)(was.clone())


def number_of(task, words):
    return [step.skill for step in CANONICAL[task].steps].index(words)


def test_random_rotations_are_uniform():
    turns = random_rotations(20_000)
    torch.testing.assert_close(turns @ turns.mT, NOW.expand(20_000, 3, 3), atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(turns), torch.ones(20_000), atol=1e-5, rtol=0)
    assert turns.mean(0).abs().max() < 0.03
    assert ((turns**2).mean(0) - 1 / 3).abs().max() < 0.02


FREE = [("push", "carry the puck to the target location"), ("peg-insert-side", "slide the peg to the hole")]
BOUND = [
    ("push", "place the gripper above the puck"),
    ("push", "close the gripper around the puck"),
    ("window-open", "push the window handle to the left"),
    ("drawer-open", "pull the drawer handle toward the robot"),
    ("button-press-topdown", "push the button down"),
]


@pytest.mark.parametrize(("task", "words"), FREE)
def test_free_motions_to_a_place_are_tilted_and_keep_their_length(task, words):
    was = in_step(task, number_of(task, words))
    now = tilted(was)
    turns = now["observation_tilt"]
    assert turns.shape == (400, 3, 3)
    assert not torch.isclose(turns, NOW).all((-1, -2)).any()
    moved = now["action"][:, :3]
    inside = moved.abs().amax(-1) < 0.999
    torch.testing.assert_close(moved.norm(dim=-1)[inside], was["action"][:, :3].norm(dim=-1)[inside])
    assert moved.abs().max() <= 1.0
    # without a direction, the row is first turned by any angle
    flat = turn_vectors(was["action"][:, :3], now["observation_yaw"]).unsqueeze(-1)
    torch.testing.assert_close(normalize(moved, dim=-1), normalize((turns @ flat).squeeze(-1), dim=-1))
    assert torch.equal(now["action"][:, 3], was["action"][:, 3])
    torch.testing.assert_close(now["observation"][:, 2], was["observation"][:, 2])


@pytest.mark.parametrize(("task", "words"), BOUND)
def test_other_motions_are_not_tilted_even_beside_a_free_one(task, words):
    was = in_step(task, number_of(task, words), also=number_of(*FREE[0]) if task == "push" else None)
    now = tilted(was)
    assert torch.equal(now["observation_tilt"], NOW.expand(400, 3, 3))
    torch.testing.assert_close(now["action"][:, 2], was["action"][:, 2])
    was["qaf"] = torch.zeros_like(was["qaf"])
    assert torch.equal(tilted(was)["observation_tilt"], NOW.expand(400, 3, 3)), "no condition is true"


def test_motions_with_a_direction_are_not_tilted():
    role = lw.canonical_plan(MT10["push"]).steps[-1].role
    ways = ("left", "right", "away", "toward", "up", None)
    roles = [replace(role, verb="move", direction=way) for way in ways]
    condition = lw.parse_query("the gripper is near the puck", "push")
    plans = lw.Plans([lw.ConditionalPlan("push", tuple(PlanStep(condition, role.skill, role=role) for role in roles))])
    was = in_step("push", 0)
    for step, way in enumerate(ways):
        was["qaf"] = one_hot(torch.full((400,), step), len(ways)).bool()
        turns = lw.RandomYaw(0.1, plans=plans, tilt=1.0)(was)["observation_tilt"]
        assert torch.equal(turns, NOW.expand(400, 3, 3)) == (way is not None)


def test_tilt_rate():
    was = in_step("push", 3, 4_000)
    share = (tilted(was, 0.25)["observation_tilt"] != NOW).any((-1, -2)).float().mean()
    assert share == pytest.approx(0.25, abs=0.03)
    assert "observation_tilt" not in tilted(was, 0.0)


@pytest.mark.parametrize("times", [1, 2])
def test_role_features_are_tilted_like_the_action(times):
    """An action towards the target stays an action towards the target that the features show."""
    was = in_step("push", 3, 50)
    was["action"][:, :3] = (was["observation"][:, 36:39] - was["observation"][:, 4:7]) * 0.3
    now = was
    for _ in range(times):
        now = lw.RandomYaw(0.5, plans=CANONICAL, tilt=1.0)(now)
    now["skill_weights"] = one_hot(torch.full((50,), 3), CANONICAL.num_steps).float()
    features = lw.modules.RoleFeatures(CANONICAL).eval()
    features.demonstrated.fill_(True)
    seen = features(now)["features"]
    torch.testing.assert_close(normalize(seen[:, :3], dim=-1), normalize(now["action"][:, :3], dim=-1))


def test_tilt_with_renamed_keys():
    was = in_step("push", 3)
    moved = was.select("qaf", "task_id", "action").set(("agent", "observation"), was["observation"])
    keys = [("agent", "observation"), "action", "expert_action", "unclipped_action"]
    now = lw.RandomYaw(0.0, plans=CANONICAL, tilt=1.0, in_keys=keys)(moved)
    assert now["agent", "observation_tilt"].shape == (400, 3, 3)
