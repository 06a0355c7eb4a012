"""Six rows of three tasks, and helpers that step them."""

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

FEW = ["door-open", "push", "reach"]
ENGINES = ["vectorized", "metaworld"]
ROWS = 6
STEPS = 12
STATE = ("observation", "task_id", "episode", "success", "fault")


def actions_of(task: int, episode: int, steps: int) -> Tensor:
    """Return random actions for one episode, (steps, 4) float32 in [-1, 1]."""
    return torch.from_numpy(np.random.default_rng([task, episode]).uniform(-1, 1, (steps, 4)).astype(np.float32))


def row_actions(state: TensorDictBase, step: int) -> Tensor:
    pairs = zip(state["task_id"].tolist(), state["episode"].tolist(), strict=True)
    return torch.stack([actions_of(task, episode, step + 1)[step] for task, episode in pairs])


def advance(env, state: TensorDictBase, action: Tensor, **more: Tensor) -> TensorDictBase:
    """Return the state after ``action``; the caller's tensors do not change."""
    return env.step(state.select(*STATE).update({"action": action.clone(), **more}))["next"]


def trajectories(env, steps: int, state: TensorDictBase | None = None) -> dict[tuple[int, int], dict[str, Tensor]]:
    """Run every episode with its own actions; return (task_id, episode) to its observations, successes and rewards."""
    state = env.reset() if state is None else state
    states = [state.select(*STATE)]
    for step in range(steps):
        state = advance(env, state, row_actions(state, step))
        states.append(state.select(*STATE, "reward", "done"))
    found = {key: torch.stack([s[key] for s in states], 1) for key in ("observation", "success")}
    found["reward"] = torch.stack([s["reward"] for s in states[1:]], 1)
    keys = zip(state["task_id"].tolist(), state["episode"].tolist(), strict=True)
    return {key: {name: values[row] for name, values in found.items()} for row, key in enumerate(keys)}


def same(left: TensorDictBase | dict, right: TensorDictBase | dict, rows=slice(None)) -> bool:
    """Return whether two states, or two episodes of :func:`trajectories`, agree in every bit."""
    keys = left.keys() & right.keys()
    assert "observation" in keys
    return all(torch.equal(left[key][rows], right[key][rows]) for key in keys)


def others(*rows: int) -> Tensor:
    return torch.tensor([row not in rows for row in range(ROWS)])
