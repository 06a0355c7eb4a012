"""The environment under a transform: its state, and the transforms that run before this one."""

from __future__ import annotations

import io
import warnings
from typing import Any, Self

import torch
from tensordict import unravel_key
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import Compose, EnvBase, RenameTransform, Transform, TransformedEnv
from torchrl.envs.batched_envs import BatchedEnvBase


def base_env(transform: Transform) -> EnvBase | None:
    """The environment under all transforms, None on a replay buffer and in a Compose that is nowhere yet."""
    try:
        env = transform.container
    except ValueError:
        return None
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def refuse_changed(transform: Transform, key: NestedKey) -> None:
    """Raise :class:`ValueError` if a transform before this one in its Composes or environments writes ``key``."""
    for earlier in reversed(_before(transform)):
        written = [unravel_key(out) for out in earlier.__dict__.get("_out_keys") or ()]
        if getattr(earlier, "makes_observation", False):
            return  # it writes the original observation, so the transforms before it do not matter
        if isinstance(earlier, RenameTransform) and key in written:
            key = unravel_key(earlier.in_keys[written.index(key)])
        elif key in written or unravel_key(("next", key)) in written:
            name, other = type(transform).__name__, type(earlier).__name__
            raise ValueError(f"{other} changes {key!r} before {name} reads it: put {name} before {other}")


def _before(transform: Transform) -> list[Transform]:
    """Return the transforms that run before one, in order."""
    found: list[Transform] = []
    inner, container = transform, _container(transform)
    while isinstance(container, Compose):
        place = next(n for n, member in enumerate(container.transforms) if member is inner)
        found = [one for member in container.transforms[:place] for one in _flat(member)] + found
        inner, container = container, _container(container)
    while isinstance(container, TransformedEnv) and isinstance(container := container.base_env, TransformedEnv):
        found = _flat(container.transform) + found
    return found


def _container(transform: Transform) -> Compose | EnvBase | None:
    reference = transform.__dict__.get("_container")
    return None if reference is None else reference()


def _flat(transform: Transform) -> list[Transform]:
    if isinstance(transform, Compose):
        return [one for member in transform.transforms for one in _flat(member)]
    return [transform]


class EpisodeTransform(Transform):
    """A transform that keeps a state of each row's episode; a clone, or a loaded one, requires a reset first."""

    def _forget_episodes(self) -> None:
        """Delete the states: no episode has begun."""

    def clone(self) -> Self:
        other: Self = super().clone()
        other._forget_episodes()
        return other

    def _load_from_state_dict(self, *args: Any) -> None:
        super()._load_from_state_dict(*args)
        self._forget_episodes()


class KeepsEnvState(EpisodeTransform):
    """A transform whose ``state_dict`` also holds the environment's, which TorchRL does not save."""

    def get_extra_state(self) -> Tensor:
        """Return the environment's ``state_dict``, as bytes (n,) uint8; empty on a replay buffer."""
        env = base_env(self)
        if isinstance(env, BatchedEnvBase) and env.is_closed:
            name, env = type(env).__name__, None
            warnings.warn(f"this {name} is not running, so the state_dict lacks its episodes", stacklevel=2)
        if env is None:
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
            raise ValueError("state_dict lacks an environment's episodes: none was running when it was taken")
        env.load_state_dict(torch.load(io.BytesIO(state.cpu().numpy().tobytes()), weights_only=True))
        if (flags := env.__dict__.get("_shm_done_flags")) is not None:
            # TorchRL 0.14.1 leaves them up after loading: a ParallelEnv would answer the next reset too early.
            flags[:] = [0] * len(flags)


class EnvState(KeepsEnvState):
    """Keep the environment's seed and episode counters in a TransformedEnv's ``state_dict``, and so in a Collector's.

    Without it, or a :class:`QAFTransform`, which does the same, a resumed collector would run the same episodes again.
    After ``load_state_dict`` the environment must be reset (``collector.reset()``). Put it around a ParallelEnv too,
    whose own ``load_state_dict`` leaves TorchRL 0.14.1 one answer behind, unless it has ``use_buffers=False``.

    Raises:
        ValueError: at loading, a state of other tasks or rows, or of no environment.

    Warns:
        UserWarning: a SerialEnv or ParallelEnv that has been closed, or not started, has no state to save.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> import lw_torchrl as lw
        >>> env, other = (TransformedEnv(lw.LanguageWorldEnv("reach"), lw.transforms.EnvState()) for _ in range(2))
        >>> _ = env.reset(), env.reset(), other.load_state_dict(env.state_dict())
        >>> other.reset()["episode"]
        tensor([2])
    """

    def __init__(self) -> None:
        super().__init__(in_keys=[], out_keys=[])


def reset_rows(before: Tensor | None, now: Tensor, begun: Tensor | None, more: int = 0) -> Tensor:
    """``now`` (B, ...), with ``more`` dims beyond B, of rows that have ``begun``, B bool or None; or ``before``"""
    if before is None or begun is None or before.shape != now.shape:
        return now
    shape = (*now.shape[: now.dim() - more], *[1] * more)
    return torch.where(begun.reshape(shape), now, before)
