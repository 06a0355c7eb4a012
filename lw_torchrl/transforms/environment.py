"""What transforms know of the environment under them, its state, and the answers that its rows are shown late."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Sequence
from itertools import product
from typing import Any, Self

import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import Compose, EnvBase, RenameTransform, SerialEnv, Transform, TransformedEnv
from torchrl.envs.batched_envs import BatchedEnvBase

from lw_torchrl._keys import check_apart, read


def base_env(transform: Transform) -> EnvBase | None:
    """The environment under all transforms, None on a replay buffer and in a Compose that is nowhere yet."""
    try:
        env = transform.container
    except ValueError:
        return None
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def refuse_changed(transform: Transform, key: NestedKey, beside: int = -1) -> int:
    """Raise :class:`ValueError` where a transform before this one says that it writes what this one is to read; return
    how many its Compose has, 0 without one. As many as ``beside`` say that none was put there since: none is asked."""
    container = _container(transform)
    now = len(container.transforms) if isinstance(container, Compose) else 0
    if now == beside:
        return now
    for entry, chain in product((key, unravel_key(("next", key))), _before(transform)):
        for earlier in reversed(chain):
            written = [unravel_key(out) for out in earlier.__dict__.get("_out_keys") or ()]
            if entry not in written:
                continue
            if getattr(earlier, "makes_observation", False):
                break  # it is the observation as it was, and what stands before it does not matter
            if isinstance(earlier, RenameTransform):
                entry = unravel_key(earlier.in_keys[written.index(entry)])
                continue
            name, other = type(transform).__name__, type(earlier).__name__
            raise ValueError(
                f"{other} changes {entry!r} before {name} reads it, which is made for the observation as it was: put "
                f"{name} before {other}"
            )
    return now


def _before(transform: Transform) -> list[list[Transform]]:
    """What runs before a transform; of several workers, a list for each."""
    found: list[Transform] = []
    inner, container = transform, _container(transform)
    while isinstance(container, Compose):
        place = next(n for n, member in enumerate(container.transforms) if member is inner)
        found = [one for member in container.transforms[:place] for one in _flat(member)] + found
        inner, container = container, _container(container)
    while isinstance(container, TransformedEnv) and isinstance(container := container.base_env, TransformedEnv):
        found = _flat(container.transform) + found
    return [inner + found for inner in _inside(container)]


def _inside(env: Compose | EnvBase | None) -> list[list[Transform]]:
    """The transforms in an environment, a list for each worker of a SerialEnv that runs."""
    if isinstance(env, TransformedEnv):
        return [inner + _flat(env.transform) for inner in _inside(env.base_env)]
    workers = env.__dict__.get("_envs", ()) if isinstance(env, SerialEnv) else ()
    return [chain for worker in workers for chain in _inside(worker)] or [[]]


def _container(transform: Transform) -> Compose | EnvBase | None:
    reference = transform.__dict__.get("_container")
    return None if reference is None else reference()


def _flat(transform: Transform) -> list[Transform]:
    if isinstance(transform, Compose):
        return [one for member in transform.transforms for one in _flat(member)]
    return [transform]


class EpisodeTransform(Transform):
    """A transform that keeps something of each row's episode; a clone, or a loaded one, wants a reset first."""

    def _forget_episodes(self) -> None:
        """No episode has begun."""

    def clone(self) -> Self:
        other: Self = super().clone()
        other._forget_episodes()
        return other

    def _load_from_state_dict(self, *args: Any) -> None:
        super()._load_from_state_dict(*args)
        self._forget_episodes()


class KeepsEnvState(EpisodeTransform):
    """A transform whose ``state_dict`` holds that of the environment under it, for TorchRL asks no one else."""

    def get_extra_state(self) -> Tensor:
        """The environment's ``state_dict``, as bytes (n,) uint8; empty on a replay buffer."""
        env = base_env(self)
        closed = isinstance(env, BatchedEnvBase) and env.is_closed
        if closed:
            told = f"this {type(env).__name__} is not running, so the state_dict says nothing of its episodes"
            warnings.warn(told, stacklevel=2)
        if env is None or closed:
            return torch.zeros(0, dtype=torch.uint8)
        buffer = io.BytesIO()
        torch.save(env.state_dict(), buffer)
        return torch.frombuffer(bytearray(buffer.getvalue()), dtype=torch.uint8)

    def set_extra_state(self, state: Tensor) -> None:
        """Hand the environment its state; a replay buffer has no use for it."""
        env = base_env(self)
        if env is None:
            return
        if not state.numel():
            raise ValueError("state_dict says nothing of an environment's episodes: none was running when it was taken")
        env.load_state_dict(torch.load(io.BytesIO(state.cpu().numpy().tobytes()), weights_only=True))
        if (flags := env.__dict__.get("_shm_done_flags")) is not None:
            # TorchRL 0.14.1 leaves them up after loading: a ParallelEnv would answer the next reset too early.
            flags[:] = [0] * len(flags)


class EnvState(KeepsEnvState):
    """Keeps the environment's seed and episode counters in a TransformedEnv's ``state_dict``, and so in a Collector's.

    Without this one, or a :class:`QAFTransform`, which does the same, a collector that is resumed would run the same
    episodes again. It changes no entry. After ``load_state_dict`` the environment must be reset
    (``collector.reset()``). Put it around a ParallelEnv too, whose own ``load_state_dict`` leaves TorchRL 0.14.1 one
    answer behind, unless it has ``use_buffers=False``.

    Raises:
        ValueError: at loading, a state of other tasks or rows, or of no environment.

    Warns:
        UserWarning: a SerialEnv or ParallelEnv that has been closed, or not started, has no state to save.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> import lw_torchrl as lw
        >>> env, other = (TransformedEnv(lw.LanguageWorldEnv("reach"), lw.transforms.EnvState()) for _ in range(2))
        >>> env.reset()["episode"], env.reset()["episode"]
        (tensor([0]), tensor([1]))
        >>> other.load_state_dict(env.state_dict())
        >>> other.reset()["episode"]
        tensor([2])
        >>> env.close(), other.close()
        (None, None)
    """

    def __init__(self) -> None:
        super().__init__(in_keys=[], out_keys=[])


def reset_rows(before: Tensor | None, now: Tensor, begun: Tensor | None, more: int = 0) -> Tensor:
    """``now`` (B, ...), with ``more`` dims beyond B, of rows that have ``begun``, B bool or None; or ``before``"""
    if before is None or begun is None or before.shape != now.shape:
        return now
    shape = (*now.shape[: now.dim() - more], *[1] * more)
    return torch.where(begun.reshape(shape), now, before)


class DelayedAnswers:
    """Counts the steps of each row's episode, and keeps the answers that it is still to be shown.

    In step t of its episode, 0 at the reset, a row is shown those of step every · ⌊max(t - delay, 0) / every⌋.
    Answers are bool, or logits, float32: of one dtype from reset to reset.
    """

    def __init__(self, every: int = 1, delay: int = 0) -> None:
        self.every, self.delay = every, delay
        self._places = -(-delay // every) + 1  # for all that were taken and are still to be shown
        self._step: Tensor | None = None  # B int64
        self._taken: Tensor | None = None  # (B, places, S); answers that were taken n-th are in place n % places
        self._shown: Tensor | None = None  # (B, S)

    @property
    def step(self) -> Tensor:
        """B int64, the step of its episode that each row is at; :class:`RuntimeError` if no episode has begun."""
        if self._step is None:
            raise RuntimeError("rows have begun no episode, or not since load_state_dict: reset the environment")
        return self._step

    def begin(self, answers: Tensor, rows: Tensor | None) -> Tensor:
        """Begin the episodes of rows (B bool, None for all) with answers (B, S): what each row is shown."""
        shape = answers.shape[:-1]
        self._step = reset_rows(self._step, torch.zeros(shape, dtype=torch.int64, device=answers.device), rows)
        self._taken = reset_rows(self._taken, answers.unsqueeze(-2).repeat(*[1] * len(shape), self._places, 1), rows, 2)
        self._shown = reset_rows(self._shown, answers.clone(), rows, 1)
        return self._shown.clone()

    def due(self, rows: Tensor | None) -> Tensor:
        """B bool, the rows, of those that make the step, whose answers :meth:`advance` takes after it."""
        taken = (self.step + 1) % self.every == 0
        return taken if rows is None else taken & rows.reshape(taken.shape)

    def advance(self, answers: Tensor, rows: Tensor | None, stuck: Callable[[], Tensor] | None = None) -> Tensor:
        """What rows are shown, (B, S), after a step; ``stuck`` gives (B, S) bool, what stays as it was shown before."""
        due = self.due(rows)
        assert self._taken is not None
        assert self._shown is not None
        self._step = step = self.step + (1 if rows is None else rows.reshape(due.shape))
        place = torch.arange(self._places, device=step.device) == (step // self.every % self._places).unsqueeze(-1)
        self._taken = torch.where((place & due.unsqueeze(-1)).unsqueeze(-1), answers.unsqueeze(-2), self._taken)
        place = (step - self.delay).clamp(min=0) // self.every % self._places
        place = place[..., None, None].expand(*place.shape, 1, self._taken.shape[-1])
        now = self._taken.gather(-2, place).squeeze(-2)
        if stuck is not None:
            stays = stuck() if rows is None else stuck() | ~rows.reshape(due.shape).unsqueeze(-1)
            now = torch.where(stays, self._shown, now)
        self._shown = now
        return now.clone()


class HeldAnswers(KeepsEnvState):
    """Writes logits (B, S) float32 as :class:`DelayedAnswers` shows them; :meth:`HeldEvaluator.transform` makes it.
    ``ask`` gives those of the rows that are due, from n rows with ``in_keys`` to (n, ``columns``) float32."""

    def __init__(
        self,
        ask: Callable[[TensorDictBase], Tensor],
        columns: int,
        *,
        every: int,
        delay: int,
        in_keys: Sequence[NestedKey],
        out_key: NestedKey,
    ) -> None:
        super().__init__(in_keys=list(in_keys), out_keys=[out_key])
        check_apart(self.in_keys, self.out_keys)
        self.ask, self.columns, self.every, self.delay = ask, columns, every, delay
        self._forget_episodes()

    def _forget_episodes(self) -> None:
        self._rows = DelayedAnswers(self.every, self.delay)

    def _asked(self, tensordict: TensorDictBase, due: Tensor) -> Tensor:
        """(B, S) float32, the answers of the rows that are due, B bool; zeros of the others."""
        first, *_ = read(tensordict, self.in_keys)
        found = torch.zeros(due.numel(), self.columns, device=first.device)
        rows = due.reshape(-1).nonzero().squeeze(-1)
        if len(rows):
            found[rows] = self.ask(tensordict.select(*self.in_keys).reshape(-1)[rows]).to(found.device)
        return found.reshape(*due.shape, self.columns)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        begun, shape = tensordict.get("_reset", None), tensordict_reset.batch_size
        due = torch.ones(shape, dtype=torch.bool) if begun is None else begun.reshape(shape)
        return tensordict_reset.set(self.out_keys[0], self._rows.begin(self._asked(tensordict_reset, due), begun))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        moved = tensordict.get("_step", None)
        answers = self._asked(next_tensordict, self._rows.due(moved))
        return next_tensordict.set(self.out_keys[0], self._rows.advance(answers, moved))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        raise ValueError(
            f"HeldEvaluator(every={self.every}, delay={self.delay}) counts the steps of an environment's episodes, "
            "which rows of a replay buffer do not tell: train a policy with the evaluator inside it, and hold it to act"
        )

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        assert isinstance(observation_spec, Composite)
        key, shape, device = self.out_keys[0], (*observation_spec.shape, self.columns), observation_spec.device
        if key in observation_spec.keys(True, True):
            raise ValueError(f"two HeldEvaluators write {key!r}: hold one, give the policy qaf in the other's place")
        observation_spec[key] = Unbounded(shape, dtype=torch.float32, device=device)
        return observation_spec
