"""The specs of LanguageWorldEnv, and what it reads from a tensordict: masks of rows, and actions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded

from lw_torchrl.envs.engine import ACTION_SIZE, OBSERVATION_SIZE
from lw_torchrl.language.tasks import MT50


class TaskIds(Categorical):
    """Each row's task: a Categorical whose zero is the row's own id, so that policies can act on an environment's
    ``fake_tensordict()``, which is of zeros: the id 0 is a task that they may not know.

    Args:
        n: how many ids there are.
        ids: (N,) int64, those of the rows.
    """

    ids: Tensor | None = None

    def __init__(self, n: int, ids: Tensor | None = None, **options: Any) -> None:
        super().__init__(n, **({} if ids is None else {"shape": ids.shape, "dtype": ids.dtype}), **options)
        self.ids = ids

    def zero(self, shape: torch.Size | None = None) -> Tensor:
        """The rows' ids, in front of them the dimensions of ``shape``."""
        if self.ids is None:
            return super().zero(shape)
        return self.ids.expand((*(shape or ()), *self.shape)).clone()

    def _with(self, made: TaskIds, ids: Callable[[Tensor], Tensor]) -> TaskIds:
        made.ids = None if self.ids is None else ids(self.ids)
        return made

    def expand(self, *shape: Any) -> TaskIds:
        made = super().expand(*shape)
        return self._with(made, lambda ids: ids.expand(made.shape))

    def _reshape(self, shape: Any) -> TaskIds:
        return self._with(super()._reshape(shape), lambda ids: ids.reshape(shape))

    def _unflatten(self, dim: int, sizes: Any) -> TaskIds:
        return self._with(super()._unflatten(dim, sizes), lambda ids: ids.unflatten(dim, sizes))

    def squeeze(self, dim: int | None = None) -> TaskIds:
        return self._with(super().squeeze(dim), lambda ids: ids.squeeze() if dim is None else ids.squeeze(dim))

    def unsqueeze(self, dim: int) -> TaskIds:
        return self._with(super().unsqueeze(dim), lambda ids: ids.unsqueeze(dim))

    def to(self, dest: Any) -> TaskIds:
        return self._with(super().to(dest), lambda ids: ids if isinstance(dest, torch.dtype) else ids.to(dest))

    def clone(self) -> TaskIds:
        return self._with(super().clone(), Tensor.clone)

    def __getitem__(self, index: Any) -> TaskIds:
        return self._with(super().__getitem__(index), lambda ids: ids[index])


def observation_spec(task_id: Tensor) -> Composite:
    """The outputs beside reward and done, of rows with these tasks, (N,) int64."""
    n = len(task_id)
    ids = len(MT50) if int(task_id.max()) < len(MT50) else 2**32  # a task of one's own has a hash
    return Composite(
        observation=Unbounded((n, OBSERVATION_SIZE)),
        task_id=TaskIds(ids, task_id),
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


def clipped_action(tensordict: TensorDictBase, batch_size: torch.Size) -> Tensor:
    """The action as it is executed, (*batch_size, 4) float32 in [-1, 1]; another shape or dtype is a ValueError."""
    action = tensordict.get("action", None)
    if action is None or action.shape != (*batch_size, ACTION_SIZE) or action.dtype != torch.float32:
        given = "none" if action is None else f"{action.dtype} of shape {tuple(action.shape)}"
        raise ValueError(f"action must be float32 of shape {(*batch_size, ACTION_SIZE)}, got {given}")
    return action.detach().clamp(-1.0, 1.0)
