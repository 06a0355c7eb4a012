"""RandomYaw's tilt: rows in which an object moves freely to a place are also turned in space."""

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

import lw_torchrl as lw
from lw_torchrl.language.plans import PlanStep
from lw_torchrl.transforms.random_yaw import random_rotations, turn_vectors

MT10 = lw.load_plans("MT10")
PLANS = lw.canonical_plans(MT10)
NOW = torch.eye(3)


def rows(task, step, number=400, reach=0.5, also=None):
    qaf = torch.zeros(number, PLANS.num_steps, dtype=torch.bool)
    qaf[:, [step, step if also is None else also]] = True
    drawn = torch.Generator().manual_seed(0)
    action = (2 * torch.rand(number, 4, generator=drawn) - 1) * reach
    ids = torch.full((number,), lw.task_id(task))
    result = TensorDict(observation=torch.rand(number, 39, generator=drawn), action=action, qaf=qaf, task_id=ids)
    return result.auto_batch_size_()


def tilted(was, tilt=1.0, scale=0.0):
    torch.manual_seed(0)
    return lw.RandomYaw(scale, plans=PLANS, tilt=tilt)(was.clone())


def number_of(task, words):
    (result,) = (number for number, step in enumerate(PLANS[task].steps) if step.skill == words)
    return result


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
    was = rows(task, number_of(task, words))
    now = tilted(was)
    turns = now["observation_tilt"]
    assert turns.shape == (400, 3, 3)
    assert not torch.isclose(turns, NOW).all((-1, -2)).any()
    moved = now["action"][:, :3]
    inside = moved.abs().amax(-1) < 0.999
    torch.testing.assert_close(moved.norm(dim=-1)[inside], was["action"][:, :3].norm(dim=-1)[inside])
    assert moved.abs().max() <= 1.0
    direction = torch.nn.functional.normalize
    yaw = now["observation_yaw"]  # without a direction, the row is first turned by any angle
    flat = turn_vectors(was["action"][:, :3], yaw)
    torch.testing.assert_close(direction(moved, dim=-1), direction((turns @ flat.unsqueeze(-1)).squeeze(-1), dim=-1))
    assert torch.equal(now["action"][:, 3], was["action"][:, 3])
    torch.testing.assert_close(now["observation"][:, 2], was["observation"][:, 2])


@pytest.mark.parametrize(("task", "words"), BOUND)
def test_other_motions_are_not_tilted_even_beside_a_free_one(task, words):
    step = number_of(task, words)
    free = number_of("push", FREE[0][1]) if task == "push" else None
    was = rows(task, step, also=free)
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
    was = rows("push", 0)
    for step, way in enumerate(ways):
        was["qaf"] = torch.nn.functional.one_hot(torch.full((400,), step), len(ways)).bool()
        turns = lw.RandomYaw(0.1, plans=plans, tilt=1.0)(was)["observation_tilt"]
        assert torch.equal(turns, NOW.expand(400, 3, 3)) == (way is not None)


def test_tilt_rate():
    was = rows("push", 3, 4_000)
    share = (tilted(was, 0.25)["observation_tilt"] != NOW).any((-1, -2)).float().mean()
    assert share == pytest.approx(0.25, abs=0.03)
    assert "observation_tilt" not in tilted(was, 0.0)


@pytest.mark.parametrize("times", [1, 2])
def test_role_features_are_tilted_like_the_action(times):
    """An action towards the target stays an action towards the target that the features show."""
    was = rows("push", 3, 50)
    was["action"][:, :3] = (was["observation"][:, 36:39] - was["observation"][:, 4:7]) * 0.3
    now = was
    for _ in range(times):
        now = lw.RandomYaw(0.5, plans=PLANS, tilt=1.0)(now)
    now["skill_weights"] = torch.nn.functional.one_hot(torch.full((50,), 3), PLANS.num_steps).float()
    features = lw.modules.RoleFeatures(PLANS).eval()
    features.demonstrated.fill_(True)
    seen = features(now)["features"]
    direction = torch.nn.functional.normalize
    torch.testing.assert_close(direction(seen[:, :3], dim=-1), direction(now["action"][:, :3], dim=-1))


def test_renamed_keys():
    was = rows("push", 3)
    moved = was.select("qaf", "task_id", "action").set(("agent", "observation"), was["observation"])
    keys = [("agent", "observation"), "action", "expert_action", "unclipped_action"]
    now = lw.RandomYaw(0.0, plans=PLANS, tilt=1.0, in_keys=keys)(moved)
    assert now["agent", "observation_tilt"].shape == (400, 3, 3)
