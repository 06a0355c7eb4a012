"""Transforms that save an environment's state or write task descriptions, and helpers for other transforms."""

from __future__ import annotations

import io
import warnings
from typing import Any, Self

import torch
from tensordict import NonTensorData, NonTensorStack, TensorDictBase, unravel_key
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, NonTensor, TensorSpec
from torchrl.envs import Compose, EnvBase, RenameTransform, Transform, TransformedEnv
from torchrl.envs.batched_envs import BatchedEnvBase

from lw_torchrl._util.checks import typed
from lw_torchrl._util.keys import Keys, as_keys, read
from lw_torchrl.language.tasks import TASKS, TaskList, named_tasks, task_id


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
            return  # earlier transforms do not matter: this transform writes the original observation
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
    """A base class for transforms that keep per-episode state; reset the environment after cloning or loading them."""

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
    """A base class of transforms whose ``state_dict`` includes that of the environment, which TorchRL does not save."""

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


class EnvState(KeepsEnvState):
    """A transform that adds the environment's seed and episode counters to the ``state_dict`` of a TransformedEnv.

    Without this transform, or a :class:`QAFTransform`, which does the same, a resumed Collector would run the same
    episodes again. After ``load_state_dict``, reset the environment (``collector.reset()``). Also use this transform
    around a ParallelEnv, unless ``use_buffers=False``: in TorchRL 0.14.1, ``ParallelEnv.load_state_dict``
    desynchronizes the workers.

    Raises:
        ValueError: the loaded state belongs to other tasks or rows, or has no environment state.

    Warns:
        UserWarning: a SerialEnv or ParallelEnv that is closed, or not started, has no state to save.

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


class LanguageInstruction(Transform):
    """A transform that writes ``language_instruction``, the task description: "Push the puck to the target location."

    Policies such as ``torchrl.modules.VLAWrapperBase`` read this key. For environments and replay buffers. Reads
    ``task_id`` (B,) int64; writes one string for each row. Strings make an environment step 1.15 to 2.5 times slower,
    so :class:`~lw_torchrl.LanguageWorldEnv` does not write them itself.

    Args:
        tasks: the tasks whose descriptions are known, as for :class:`~lw_torchrl.LanguageWorldEnv`, or their plans;
            None for the 50 tasks and the tasks of the environment.
        in_keys, out_keys: replacements for the keys ``task_id`` and ``language_instruction``.

    Raises:
        ValueError: at call time, a task is not among ``tasks``.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> import lw_torchrl as lw
        >>> env = TransformedEnv(lw.LanguageWorldEnv(["reach", "push"]), lw.transforms.LanguageInstruction())
        >>> env.reset()["language_instruction"][0] == lw.TASKS["push"].description
        True

    Source: ``torchrl.envs.LiberoEnv``.
    """

    @typed
    def __init__(
        self, tasks: TaskList | None = None, *, in_keys: Keys | None = None, out_keys: Keys | None = None
    ) -> None:
        keys = as_keys("in_keys", in_keys, ("task_id",))
        super().__init__(in_keys=keys, out_keys=as_keys("out_keys", out_keys, ("language_instruction",)))
        known = TASKS.values() if tasks is None else named_tasks(tasks).values()
        self._texts = {task_id(task.name): NonTensorData(task.description) for task in known}

    def _text(self, number: int) -> NonTensorData:
        if number not in self._texts:
            for task in getattr(base_env(self), "task_of_row", ()):
                self._texts.setdefault(task_id(task.name), NonTensorData(task.description))
        if number not in self._texts:
            raise ValueError(f"task_id {number} is not among the tasks of LanguageInstruction: pass tasks=")
        return self._texts[number]

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        (ids,) = read(next_tensordict, self.in_keys)
        shape = next_tensordict.batch_size
        texts = [self._text(number) for number in ids.reshape(-1).tolist()]
        value: Any = texts[0] if not shape else NonTensorStack(*texts).reshape(shape)
        return next_tensordict.set(self.out_keys[0], value)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        assert isinstance(observation_spec, Composite)
        shape, device = observation_spec.shape, observation_spec.device
        example = next(iter(self._texts.values())).data
        observation_spec[self.out_keys[0]] = NonTensor(shape, example_data=example, device=device)
        return observation_spec


def reset_rows(before: Tensor | None, now: Tensor, begun: Tensor | None, more: int = 0) -> Tensor:
    """Return ``now`` (B, ...) in rows where ``begun`` (B bool, or None for all rows) is true, and ``before`` elsewhere.

    The tensors have ``more`` dimensions in addition to the batch dimensions B.
    """
    if before is None or begun is None or before.shape != now.shape:
        return now
    shape = (*now.shape[: now.dim() - more], *[1] * more)
    return torch.where(begun.reshape(shape), now, before)
