"""The specs of LanguageWorldEnv, and what it reads from a tensordict: masks of rows, and actions."""

from __future__ import annotations

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded

from lw_torchrl.envs.engine import ACTION_SIZE, OBSERVATION_SIZE
from lw_torchrl.language.tasks import MT50


def observation_spec(task_id: Tensor) -> Composite:
    """The outputs beside reward and done, of rows with these tasks, (N,) int64."""
    n = len(task_id)
    ids = len(MT50) if int(task_id.max()) < len(MT50) else 2**32  # a task of one's own has a hash
    return Composite(
        observation=Unbounded((n, OBSERVATION_SIZE)),
        task_id=Categorical(ids, shape=(n,), dtype=torch.int64),
        episode=Unbounded((n,), dtype=torch.int64),
        success=_flag(n),
        fault=_flag(n),
        executed_action=action_spec(n),
        shape=(n,),
    )


def action_spec(n: int) -> Bounded:
    """The action of each of n rows."""
    return Bounded(-1.0, 1.0, (n, ACTION_SIZE))


def reward_spec(n: int) -> Unbounded:
    """The reward of each of n rows."""
    return Unbounded((n, 1))


def done_spec(n: int) -> Composite:
    """How each of n rows may end."""
    return Composite(done=_flag(n), terminated=_flag(n), truncated=_flag(n), shape=(n,))


def _flag(n: int) -> Categorical:
    return Categorical(2, shape=(n, 1), dtype=torch.bool)


def row_mask(tensordict: TensorDictBase | None, key: str, n: int) -> np.ndarray:
    """The rows that a mask such as "_reset" names, (n,) bool; all where there is none.

    Raises:
        ValueError: another number of rows, or dtype.
    """
    mask = None if tensordict is None else tensordict.get(key, None)
    if mask is None:
        return np.ones(n, dtype=bool)
    if mask.dtype != torch.bool or mask.numel() != n:
        raise ValueError(f"{key} must be bool of shape ({n},) or ({n}, 1), got {mask.dtype} of {tuple(mask.shape)}")
    return mask.reshape(n).cpu().numpy()


def clipped_action(tensordict: TensorDictBase, n: int) -> Tensor:
    """The action as it is executed, (n, 4) float32 in [-1, 1]; another shape or dtype is a ValueError."""
    action = tensordict.get("action", None)
    if action is None or action.shape != (n, ACTION_SIZE) or action.dtype != torch.float32:
        given = "none" if action is None else f"{action.dtype} of shape {tuple(action.shape)}"
        raise ValueError(f"action must be float32 of shape {(n, ACTION_SIZE)}, got {given}")
    return action.detach().clamp(-1.0, 1.0)
