"""Base classes of transforms that keep state, and helpers for other transforms."""

from __future__ import annotations

import io
import warnings
from typing import Any, Self, TypeVar

import torch
from tensordict import unravel_key
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import Compose, EnvBase, RenameTransform, Transform, TransformedEnv
from torchrl.envs.batched_envs import BatchedEnvBase

State = TypeVar("State")


def base_env(transform: Transform) -> EnvBase | None:
    """Return the environment below all transforms, or None on a replay buffer or in a Compose without a container."""
    try:
        env = transform.container
    except ValueError:
        return None
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def refuse_changed(transform: Transform, key: NestedKey) -> None:
    """Raise a :class:`ValueError` if a transform that runs before ``transform`` writes ``key``."""
    for earlier in reversed(_before(transform)):
        written = [unravel_key(out) for out in earlier.__dict__.get("_out_keys") or ()]
        if getattr(earlier, "makes_observation", False):
            return  # this transform writes the original observation, so earlier changes do not matter
        if isinstance(earlier, RenameTransform) and key in written:
            key = unravel_key(earlier.in_keys[written.index(key)])
        elif key in written or unravel_key(("next", key)) in written:
            name, other = type(transform).__name__, type(earlier).__name__
            raise ValueError(f"{other} changes {key!r} before {name} reads it: put {name} before {other}")


def _before(transform: Transform) -> list[Transform]:
    """Return the transforms that run before ``transform``, in order."""
    transforms: list[Transform] = []
    inner, container = transform, _container(transform)
    while isinstance(container, Compose):
        place = next(n for n, member in enumerate(container.transforms) if member is inner)
        transforms = [each for member in container.transforms[:place] for each in _flat(member)] + transforms
        inner, container = container, _container(container)
    while isinstance(container, TransformedEnv) and isinstance(container := container.base_env, TransformedEnv):
        transforms = _flat(container.transform) + transforms
    return transforms


def _container(transform: Transform) -> Compose | EnvBase | None:
    # Unlike Transform.container, do not skip Composes, and return None without a container.
    reference = transform.__dict__.get("_container")
    return None if reference is None else reference()


def _flat(transform: Transform) -> list[Transform]:
    if isinstance(transform, Compose):
        return [each for member in transform.transforms for each in _flat(member)]
    return [transform]


class EpisodeTransform(Transform):
    """Base class for transforms that keep state per episode. After cloning or loading state, reset the environment."""

    def _forget_episodes(self) -> None:
        """Delete the state of all episodes, so that a reset is required."""

    def clone(self) -> Self:
        other: Self = super().clone()
        other._forget_episodes()
        return other

    def _load_from_state_dict(self, *args: Any) -> None:
        super()._load_from_state_dict(*args)
        self._forget_episodes()


class KeepsEnvState(EpisodeTransform):
    """Base class for transforms that save the environment's state in their own ``state_dict``.

    TorchRL does not save this state, so a resumed Collector would otherwise repeat the same episodes. After
    ``load_state_dict``, reset the environment (``collector.reset()``).
    """

    def get_extra_state(self) -> Tensor:
        """Return the environment's ``state_dict`` as bytes (n,) uint8, or an empty tensor on a replay buffer."""
        env = base_env(self)
        if isinstance(env, BatchedEnvBase) and env.is_closed:
            name, env = type(env).__name__, None
            warnings.warn(f"this {name} is not running, so the state_dict lacks the episode counters", stacklevel=2)
        if env is None:
            return torch.zeros(0, dtype=torch.uint8)
        buffer = io.BytesIO()
        torch.save(env.state_dict(), buffer)
        return torch.frombuffer(bytearray(buffer.getvalue()), dtype=torch.uint8)

    def set_extra_state(self, state: Tensor) -> None:
        """Load the environment's state; do nothing on a replay buffer."""
        env = base_env(self)
        if env is None:
            return
        if not state.numel():
            raise ValueError("state_dict lacks episode counters: it was saved while the environment was not running")
        env.load_state_dict(torch.load(io.BytesIO(state.cpu().numpy().tobytes()), weights_only=True))
        if (flags := env.__dict__.get("_shm_done_flags")) is not None:
            # TorchRL 0.14.1 does not clear these flags after loading: a ParallelEnv would reset too early.
            flags[:] = [0] * len(flags)


def begun(state: State | None) -> State:
    """Return a transform's ``state`` of the episodes; raise a :class:`RuntimeError` if a reset has not yet set it."""
    if state is None:
        raise RuntimeError("no episode has begun: reset the environment before the first step")
    return state


def reset_rows(before: Tensor | None, now: Tensor, which: Tensor | None, more: int = 0) -> Tensor:
    """Return ``now`` (B, ...) in rows where ``which`` (B bool, or None for all rows) is true, and ``before`` elsewhere.
    The tensors have ``more`` dimensions in addition to the batch dimensions B."""
    if before is None or which is None or before.shape != now.shape:
        return now
    shape = (*now.shape[: now.dim() - more], *[1] * more)
    return torch.where(which.reshape(shape), now, before)
