"""The specs of LanguageWorldEnv, and the state of the N environments in the batch (rows)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded

from lw_torchrl.language.layout import Layout
from lw_torchrl.language.tasks import MT50, task_id


def _with_ids(method: Callable[..., Any], change: Callable[..., Tensor] = lambda ids, *_args, **_kwargs: ids) -> Any:
    """Wrap a method of Categorical that returns a new spec; give the new spec the ids transformed by ``change``."""

    def wrapped(self: TaskIds, *args: Any, **kwargs: Any) -> TaskIds:
        spec = method(self, *args, **kwargs)
        spec.ids = None if self.ids is None else change(self.zero(), *args, **kwargs)
        return spec

    return wrapped


class TaskIds(Categorical):
    """The spec of ``task_id``, whose zero is each row's own task id, (N,) int64. TorchRL calls policies on the zeros of
    ``fake_tensordict()``, and a policy may not know the task with id 0.
    """

    ids: Tensor | None = None

    def __init__(self, n: int, ids: Tensor | None = None, **options: Any) -> None:
        super().__init__(n, **({} if ids is None else {"shape": ids.shape, "dtype": ids.dtype}), **options)
        self.ids = ids

    def zero(self, shape: torch.Size | None = None) -> Tensor:
        """Return the rows' task ids, with ``shape`` as leading batch dimensions."""
        if self.ids is None or self.ids.numel() != self.shape.numel():
            return super().zero(shape)
        # Transforms such as UnsqueezeTransform assign a new shape to the spec.
        return self.ids.reshape(self.shape).expand((*(shape or ()), *self.shape)).clone()

    expand = _with_ids(Categorical.expand, Tensor.expand)
    __getitem__ = _with_ids(Categorical.__getitem__, Tensor.__getitem__)
    to = _with_ids(Categorical.to, lambda ids, dest: ids if isinstance(dest, torch.dtype) else ids.to(dest))
    _reshape = _with_ids(Categorical._reshape)
    _unflatten = _with_ids(Categorical._unflatten)
    squeeze = _with_ids(Categorical.squeeze)
    unsqueeze = _with_ids(Categorical.unsqueeze)
    clone = _with_ids(Categorical.clone)


def observation_spec(task_id: Tensor, layout: Layout) -> Composite:
    """Return the spec of all outputs except reward and done, for N rows with task ids (N,) int64."""
    n = len(task_id)
    ids = len(MT50) if int(task_id.max()) < len(MT50) else 2**32  # a custom task's id is a hash
    return Composite(
        observation=Unbounded((n, layout.size), dtype=torch.float32),
        task_id=TaskIds(ids, task_id),
        episode=Unbounded((n,), dtype=torch.int64),
        success=_flag(n),
        fault=_flag(n),
        executed_action=action_spec(n, layout),
        shape=(n,),
    )


def action_spec(n: int, layout: Layout) -> Bounded:
    return Bounded(-1.0, 1.0, (n, layout.action_size), dtype=torch.float32)


def done_spec(n: int) -> Composite:
    return Composite(done=_flag(n), terminated=_flag(n), truncated=_flag(n), shape=(n,))


def _flag(n: int) -> Categorical:
    return Categorical(2, shape=(n, 1), dtype=torch.bool)


def clipped_action(tensordict: TensorDictBase, shape: tuple[int, ...]) -> Tensor:
    """Return the action, clipped to [-1, 1]; raise an error unless it is float32 of the expected shape."""
    action = tensordict.get("action", None)
    if action is None or action.shape != shape or action.dtype != torch.float32:
        got = "no action" if action is None else f"{action.dtype} of shape {tuple(action.shape)}"
        raise ValueError(f"action must be float32 of shape {shape}, got {got}")
    return action.detach().clamp(-1.0, 1.0)


Rows = NDArray[np.intp]


class RowStates:
    """The state of N rows: the last observation (N, D) float32; the episode (-1 before the first reset) and the time
    steps since the reset, (N,) int64; and the flags over (true before the first reset), terminated, fault and success,
    (N,) bool.
    """

    def __init__(self, tasks: Sequence[str], layout: Layout) -> None:
        self.tasks, self.layout = tasks, layout
        self.task_id = torch.tensor([task_id(task) for task in tasks])
        n = len(tasks)
        self.observation = np.zeros((n, layout.size), dtype=np.float32)
        self.episode = np.full(n, -1, dtype=np.int64)
        self.steps = np.zeros(n, dtype=np.int64)
        self._flags = np.zeros((4, n), dtype=bool)
        self.over, self.terminated, self.fault, self.success = self._flags
        self.over[:] = True

    def begin(self, rows: Rows, episodes: NDArray[np.int64], observation: NDArray[np.float64]) -> None:
        self.observation[rows] = observation
        self.episode[rows] = episodes
        self.steps[rows] = 0
        self._flags[:, rows] = False

    def as_tensordict(self, executed_action: NDArray[np.float32] | None = None, **more: Tensor) -> TensorDict:
        """Return a copy of the state as a TensorDict (N,), with ``executed_action`` (N, A) float32 (None for zeros) and
        the additional entries ``more``.
        """
        n = len(self.tasks)
        over, terminated, fault, success = (torch.from_numpy(flag.copy()).unsqueeze(-1) for flag in self._flags)
        if executed_action is None:
            executed_action = np.zeros((n, self.layout.action_size), dtype=np.float32)
        return TensorDict(
            {
                "observation": torch.from_numpy(self.observation.copy()),
                "task_id": self.task_id.clone(),
                "episode": torch.from_numpy(self.episode.copy()),
                "success": success,
                "fault": fault,
                "executed_action": torch.from_numpy(executed_action),
                "done": over,
                "terminated": terminated,
                "truncated": over & ~terminated,
                **more,
            },
            batch_size=(n,),
            device=torch.device("cpu"),
        )
