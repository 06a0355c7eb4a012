"""Custom engines and tasks, and the shipped engines by name."""

import numpy as np
import pytest
import torch
from rows import FEW, advance
from tensordict import TensorDict
from torchrl.envs import check_env_specs

import lw_torchrl as lw
from lw_torchrl.envs.episodes import run_episodes
from lw_torchrl.envs.rows import action_noise, episode_seed
from lw_torchrl.suites.engine import EngineStep

STACK = lw.Task("stack-cups", "Stack the cups.", (*lw.TASKS["reach"].objects,))
STACK_ID = lw.task_id("stack-cups")


class FakeEngine:
    """A custom engine whose observations count steps in thirds."""

    def __init__(self, tasks: list[str], **options: object) -> None:
        self.tasks, self.options, self.count, self.closed = tasks, options, np.zeros(len(tasks)), 0
        self.resets: list[tuple[list[int], list[int]]] = []
        self.steps: list[tuple[np.ndarray, np.ndarray]] = []

    def _observe(self) -> np.ndarray:
        return np.repeat(self.count[:, None] / 3 + np.arange(len(self.tasks))[:, None], 39, axis=1)

    def reset(self, rows, seeds) -> np.ndarray:
        self.resets.append((list(rows), list(seeds)))
        self.count[list(rows)] = 0
        return self._observe()[list(rows)]

    def step(self, action, active) -> EngineStep:
        self.steps.append((action.copy(), active.copy()))
        self.count += active
        return EngineStep(self._observe(), action[:, 0] / 3, active.copy(), np.zeros_like(active))

    def close(self) -> None:
        self.closed += 1


def test_a_custom_engine_gets_rows_seeds_and_actions():
    env = lw.LanguageWorldEnv(FEW, seed=4, max_steps=5, engine=FakeEngine, reward="dense", num_threads=2)
    engine = env.engine
    assert env.observation_spec["task_id"].space.n == 50
    assert (engine.tasks, engine.options) == (FEW, {"reward": "dense", "num_threads": 2})
    state = env.reset()
    assert engine.resets == [([0, 1, 2], [episode_seed(task, 4, 0) for task in FEW])]
    assert state["observation"].dtype == torch.float32
    action = torch.full((3, 4), 0.1)
    action[2] = 7.0
    state = advance(env, state, action, _step=torch.tensor([True, False, True]))
    sent, active = engine.steps[0]
    assert (sent.dtype, sent[[0, 2], 0].tolist()) == (np.float32, [np.float32(0.1), 1.0])
    assert active.tolist() == [True, False, True]
    assert state["observation"][:, 0].tolist() == [np.float32(1 / 3), 1.0, np.float32(2 + 1 / 3)]
    torch.testing.assert_close(state["reward"].flatten(), torch.tensor([0.1 / 3, 0.0, 1 / 3]))
    assert state["success"].flatten().tolist() == [True, False, True]
    env.reset(TensorDict({"_reset": torch.tensor([False, False, True])}, [3]))
    assert engine.resets[1] == ([2], [episode_seed("reach", 4, 1)])
    for _ in range(2):
        env.close(raise_if_closed=False)
        assert engine.closed == 1


@pytest.mark.parametrize("tasks", [["reach", STACK], [STACK, "reach"], (t for t in (STACK, lw.TASKS["reach"]))])
def test_a_custom_task_runs_with_others(tasks):
    env = lw.LanguageWorldEnv(tasks, num_envs=3, seed=4, max_steps=5, engine=FakeEngine)
    assert env.tasks == ("reach", "stack-cups")
    assert list(env.row_tasks) == env.engine.tasks == ["reach", "stack-cups", "reach"]
    check_env_specs(env)
    env.set_seed(4)
    assert env.reset()["task_id"].tolist() == [lw.task_id("reach"), STACK_ID, lw.task_id("reach")]
    seeds = [episode_seed("reach", 4, 0), episode_seed(STACK, 4, 0), episode_seed("reach", 4, 1)]
    assert env._engine.resets[-1] == ([0, 1, 2], seeds)
    assert episode_seed(lw.TASKS["reach"], 4, 0) == episode_seed("reach", 4, 0)
    env.load_state_dict(env.state_dict())
    assert env.reset()["episode"].tolist() == [2, 1, 3]


def test_episodes_of_a_custom_task_have_noise():
    env = lw.LanguageWorldEnv([STACK, "push"], seed=4, max_steps=5, engine=FakeEngine)
    still = lambda td: td.set("action", torch.zeros(2, 4))  # noqa: E731
    options = {"keys": ["action", "episode"], "noise": lambda _: (0.1,) * 4}
    (steps,) = [episode.steps for episode in run_episodes(env, still, {"stack-cups": [3]}, **options)]
    assert steps["episode"].tolist() == [3] * 5
    assert torch.equal(steps["action"], torch.from_numpy(action_noise(STACK, 4, 3, 5) * np.float32(0.1)).clamp(-1, 1))
