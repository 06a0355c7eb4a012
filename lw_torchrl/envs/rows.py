"""The rows of LanguageWorldEnv: their specs, their state, and the episodes that they run."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded

from lw_torchrl._util.checks import check_value, shown
from lw_torchrl._util.files import parse_json
from lw_torchrl._util.reproducibility import episode_generator, episode_hash
from lw_torchrl.language.layout import Layout
from lw_torchrl.language.tasks import MT50, Task, task_id

Rows = NDArray[np.intp]
Episodes = NDArray[np.int64]


def episode_seed(task: str | Task, seed: int, episode: int) -> int:
    """Return an episode's seed for Meta-World's ``env.seed``, in [0, 2**63): a stable hash of (task, seed, episode).

    The task is a name, such as "pick-place", or a custom :class:`Task`.

    Example:
        >>> episode_seed("reach", 0, 1) == episode_seed("reach", 1, 0)
        False
    """
    return episode_hash("episode", task, seed, episode)


def action_noise(
    task: str | Task, seed: int, episode: int, steps: int, hold: int = 1, size: int = 4
) -> NDArray[np.float32]:
    """Return standard normal noise (steps, size) float32 for an episode's actions. Each value lasts ``hold`` steps."""
    generator = episode_generator("noise", task, seed, episode)
    draws = generator.standard_normal((-(-steps // hold), size), dtype=np.float32)
    return draws.repeat(hold, axis=0)[:steps]


class EpisodeCounter:
    """A counter that assigns episode indices to the rows of a :class:`LanguageWorldEnv`.

    Args:
        tasks: the task of each row.
        seed: the seed of the episodes.
        worker: this worker's index and the number of workers; workers run different episodes.
    """

    def __init__(self, tasks: Sequence[Task], seed: int, worker: tuple[int, int]) -> None:
        self.tasks = tuple(tasks)
        self.names = [task.name for task in tasks]
        n = len(set(self.names))
        self.seed = seed
        self.resets = np.zeros(len(tasks), dtype=np.int64)
        rows = np.arange(len(tasks))
        # The r-th of a task's R rows in worker w of W runs the episodes w·R + r, then every (W·R)-th after it.
        self._rank, copies = rows // n, np.bincount(rows % n)[rows % n]
        self._first, self._stride = worker[0] * copies + self._rank, worker[1] * copies

    def next(self, rows: Rows) -> Episodes:
        return (self.resets * self._stride + self._first)[rows]

    def requested(self, episode: int | Tensor, rows: Rows) -> Episodes:
        """Return the requested episodes of ``rows``; ``episode`` is an integer for all rows or an int64 tensor (N,)."""
        n = len(self.names)
        numbers = (
            episode.cpu().numpy() if isinstance(episode, Tensor) else np.array(check_value("episode", episode, int))
        )
        if numbers.shape not in ((), (n,)) or numbers.dtype.kind != "i" or (numbers < 0).any():
            raise ValueError(f"episode must be a non-negative int, or int64 of shape ({n},), got {shown(episode)}")
        return np.broadcast_to(numbers, n)[rows].astype(np.int64)

    def seeds(self, rows: Rows, episodes: Episodes) -> list[int]:
        pairs = zip(rows, episodes, strict=True)
        return [episode_seed(self.tasks[row], self.seed, int(episode)) for row, episode in pairs]

    def dump(self) -> Tensor:
        """Return tasks, seed and counters as a tensor of JSON bytes (n,) uint8."""
        state = {"tasks": self.names, "seed": self.seed, "resets": self.resets.tolist()}
        return torch.frombuffer(bytearray(json.dumps(state).encode()), dtype=torch.uint8)

    def load(self, dumped: Tensor) -> None:
        """Restore seed and counters from the :meth:`dump` of a counter with the same rows."""
        state = parse_json(dumped.cpu().numpy().tobytes())
        if state["tasks"] != self.names:
            rows, own_rows = (f"{len(names)} rows, {shown(names)}" for names in (state["tasks"], self.names))
            raise ValueError(f"state_dict belongs to an environment with other rows: {rows}; this one has {own_rows}")
        self.seed, self.resets = state["seed"], np.array(state["resets"], dtype=np.int64)


def _with_ids(method: Callable[..., Any], change: Callable[..., Tensor] = lambda ids, *_args, **_kwargs: ids) -> Any:
    """Wrap a method of Categorical that returns a new spec; the new spec keeps the task ids, changed by ``change``."""

    def wrapped(self: TaskIds, *args: Any, **kwargs: Any) -> TaskIds:
        spec = method(self, *args, **kwargs)
        spec.ids = None if self.ids is None else change(self.zero(), *args, **kwargs)
        return spec

    return wrapped


class TaskIds(Categorical):
    """The spec of ``task_id`` (N,) int64. Its ``zero()`` returns each row's own task id, because TorchRL calls policies
    on the zeros of ``fake_tensordict()``, and a policy may not know the task with id 0."""

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


def read_action(tensordict: TensorDictBase, size: int) -> Tensor:
    """Return the ``action`` that an actor wrote; raise a ValueError unless the action is (*B, size) float32."""
    action, shape = tensordict.get("action", None), (*tensordict.batch_size, size)
    if action is None or action.shape != shape or action.dtype != torch.float32:
        got = f"{action.dtype} of shape {tuple(action.shape)}" if action is not None else "no action"
        raise ValueError(f"action must be float32 of shape {shape}, got {got}")
    return action


class RowStates:
    """The state of N rows.

    Attributes:
        observation: (N, D) float32, the last observation.
        episode: (N,) int64, the episode index; -1 before the first reset.
        steps: (N,) int64, time steps since the reset.
        over, terminated, fault, success: (N,) bool flags; ``over`` is true before the first reset.
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
        """Return a copy of the state as a TensorDict (N,), with the additional entries ``more``.

        ``executed_action`` is (N, A) float32; None writes zeros.
        """
        over, terminated, fault, success = (torch.from_numpy(flag.copy()).unsqueeze(-1) for flag in self._flags)
        n, size = len(self.tasks), self.layout.action_size
        executed = (
            torch.zeros(n, size, dtype=torch.float32) if executed_action is None else torch.from_numpy(executed_action)
        )
        return TensorDict(
            {
                "observation": torch.from_numpy(self.observation.copy()),
                "task_id": self.task_id.clone(),
                "episode": torch.from_numpy(self.episode.copy()),
                "success": success,
                "fault": fault,
                "executed_action": executed,
                "done": over,
                "terminated": terminated,
                "truncated": over & ~terminated,
                **more,
            },
            batch_size=(n,),
            device="cpu",
        )
