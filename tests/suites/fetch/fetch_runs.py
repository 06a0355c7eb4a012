"""Episodes of Fetch: gymnasium-robotics' own, the engine's, and those of plans with scripted skills."""

import gymnasium
import gymnasium_robotics
import numpy as np
import torch
from tensordict import TensorDict

import lw_torchrl as lw
from lw_torchrl.suites.fetch import FetchEngine, load_plans, load_skills
from lw_torchrl.transforms.qaf import plan_program

gymnasium.register_envs(gymnasium_robotics)
IDS = {
    "fetch/pick-and-place": "FetchPickAndPlace",
    "fetch/push": "FetchPush",
    "fetch/reach": "FetchReach",
    "fetch/slide": "FetchSlide",
}
ORIGINS = {"fetch/slide": (0.395, 0.75, 0.3955)}  # in Fetch's axes; the others have (0.745, 0.75, 0.40675)


def random_actions(seed: int, steps: int) -> np.ndarray:
    """Draw actions (steps, 4) float32 in [-1, 1]."""
    return np.random.default_rng(seed).uniform(-1, 1, (steps, 4)).astype(np.float32)


def ours(task: str, positions: np.ndarray) -> np.ndarray:
    origin = ORIGINS.get(task, (0.745, 0.75, 0.40675))
    x, y, z = (positions - np.array(origin)).T
    return np.array([-y, x, z])


def observed(task: str, env: gymnasium.Env, told: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the 11 present numbers and the 3 of the goal from a state of gymnasium-robotics."""
    numbers, lift = told["observation"], np.array([0.0, 0.0, 0.03])
    thing = task != "fetch/reach"
    fingers = numbers[9:11] if thing else numbers[3:5]
    now = np.zeros(11)
    now[:3] = ours(task, numbers[:3]) + lift
    now[3] = np.clip((fingers[0] + fingers[1]) / 0.1, 0.0, 1.0)
    if thing:
        w, x, y, z = env.unwrapped.data.body("object0").xquat
        now[4:7], now[7:] = ours(task, told["achieved_goal"]), (w, -y, x, z)
    goal = ours(task, told["desired_goal"])
    return now, goal if thing else goal + lift


def gymnasium_episode(task: str, seed: int, actions: np.ndarray) -> dict[str, np.ndarray]:
    """Run our actions (steps, 4) in a new environment of gymnasium-robotics without its time limit."""
    env = gymnasium.make(f"{IDS[task]}Dense-v4", max_episode_steps=1_000)
    now, goal = observed(task, env, env.reset(seed=seed)[0])
    episode: dict[str, list] = {"observation": [[*now, *now, *goal]], "reward": [], "success": [], "state": []}
    for right, away, up, effort in actions:
        state, reward, _, _, info = env.step(np.array([away, -right, up, -effort], dtype=actions.dtype))
        before = now
        now, goal = observed(task, env, state)
        values = [*now, *before, *goal], reward, bool(info["is_success"]), physics(env.unwrapped.data)
        for name, value in zip(episode, values, strict=True):
            episode[name].append(value)
    env.close()
    return {name: np.array(numbers) for name, numbers in episode.items()}


def physics(data) -> np.ndarray:
    """Return the positions and velocities of all joints."""
    return np.concatenate((data.qpos, data.qvel))


def engine_episode(engine: FetchEngine, row: int, seed: int, actions: np.ndarray) -> dict[str, np.ndarray]:
    """Run actions in one row while the others rest."""
    episode: dict[str, list] = {
        "observation": [engine.reset([row], [seed])[0]],
        "reward": [],
        "success": [],
        "state": [],
    }
    active = np.arange(len(engine._rows)) == row
    for action in actions:
        result = engine.step(active[:, None] * action, active)
        for name in ("observation", "reward", "success"):
            episode[name].append(getattr(result, name)[row])
        episode["state"].append(physics(engine._rows[row].data))
    return {name: np.array(numbers) for name, numbers in episode.items()}


def scripted(task: str, seeds: range, steps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Run the plan with scripted skills; return actions (steps, rows, 4), successes and numbers of true steps."""
    plans = lw.Plans([load_plans()[task]])
    actor, program = lw.ScriptedSkillActor(plans, skills=load_skills()), plan_program(plans)
    rows = len(seeds)
    engine = FetchEngine([task] * rows)
    numbers, task_id = engine.reset(range(rows), seeds), torch.full((rows,), lw.task_id(task))
    actions, successes, true = [], [], []
    for _ in range(steps):
        observation = torch.from_numpy(numbers).float()
        qaf = program(observation, task_id)
        state = actor(TensorDict({"observation": observation, "task_id": task_id, "qaf": qaf}, [rows]))
        result = engine.step(state["action"].numpy(), np.ones(rows, bool))
        assert not result.fault.any()
        numbers = result.observation
        actions.append(state["action"].numpy())
        successes.append(result.success)
        true.append(qaf.sum(-1).numpy())
    engine.close()
    return np.array(actions), np.array(successes), np.array(true)
