"""Transforms that write observations: camera pictures, the task's description, and the observation of a layout."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import NonTensorData, NonTensorStack, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, NonTensor, TensorSpec, Unbounded, UnboundedDiscrete
from torchrl.envs import EnvBase, Transform
from torchrl.envs.batched_envs import BatchedEnvBase

from lw_torchrl._util.checks import Count, typed
from lw_torchrl._util.keys import Keys, as_keys, read
from lw_torchrl._util.rendering import check_cameras
from lw_torchrl.language.tasks import TASKS, Task, TaskList, named_tasks, task_id
from lw_torchrl.transforms.environment import KeepsEnvState, base_env, begun, reset_rows


class CameraTransform(KeepsEnvState):
    """A transform that writes ``pixels`` (B, height, width·C, 3) uint8, the images of C cameras from left to right.

    A row is rendered at its reset and then every N time steps of its episode; its image stays the same in between.
    Rows outside a ``_step`` or ``_reset`` mask are not rendered. The ``state_dict`` includes the environment's, as for
    :class:`QAFTransform`. With SerialEnv and ParallelEnv, put this transform into each worker.

    Args:
        cameras: one or more of "corner2", "corner", "corner3", "corner4", "topview", "behindGripper", "gripperPOV".
        height, width: size of each image, in pixels.
        every: N, the number of time steps between two images.
        out_keys: a replacement for the key ``pixels``.

    Raises:
        ValueError: a camera is unknown, an image is too large, or the transform is used on a replay buffer.
        TypeError: the base environment is not a LanguageWorldEnv.
        RuntimeError: the environment takes a step without a reset, or without a reset since ``load_state_dict``.
        ImportError: OpenGL is missing; the message names what to install.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> import lw_torchrl as lw
        >>> env = TransformedEnv(lw.LanguageWorldEnv("reach"), lw.transforms.CameraTransform(("corner", "corner3")))
        >>> env.reset()["pixels"].shape
        torch.Size([1, 64, 128, 3])

    Source: ``torchrl.record.PixelRenderTransform``, but only for selected rows and time steps.
    """

    @typed
    def __init__(
        self,
        cameras: str | Sequence[str] = "corner",
        *,
        height: Count = 64,
        width: Count = 64,
        every: Count = 1,
        out_keys: Keys | None = None,
    ) -> None:
        self.cameras = check_cameras(cameras, height, width)
        self.height, self.width, self.every = height, width, every
        super().__init__(in_keys=[], out_keys=as_keys("out_keys", out_keys, ("pixels",)))
        self.shape = self.height, self.width * len(self.cameras), 3  # the shape of a row's pictures
        self._forget_episodes()

    def _forget_episodes(self) -> None:
        self._taken: Tensor | None = None  # (N, height, width·C, 3) uint8
        self._steps: Tensor | None = None  # (N,) int64, time steps since each row's reset

    def set_container(self, container: Transform | EnvBase) -> None:
        super().set_container(container)
        env = base_env(self)
        if isinstance(env, BatchedEnvBase) or not (env is None or hasattr(env, "row_tasks")):
            name = type(env).__name__
            raise TypeError(f"CameraTransform needs a LanguageWorldEnv (in each worker), got {name}")

    def _draw(self, which: Tensor, tensordict: TensorDictBase) -> TensorDictBase:
        """Render images of the rows selected by ``which`` (N,) bool, and write the latest images of all N rows."""
        env: Any = base_env(self)
        rows = which.nonzero().flatten()
        if self._taken is None:
            self._taken = torch.zeros(len(which), *self.shape, dtype=torch.uint8)
        if len(rows):
            size = {"height": self.height, "width": self.width, "rows": rows.tolist()}
            pictures = [env.render(camera=camera, **size) for camera in self.cameras]
            # With batch_size=(), the environment returns a picture without a batch dimension.
            self._taken[rows] = torch.cat([each if each.dim() == 4 else each[None] for each in pictures], -2)
        return tensordict.set(self.out_keys[0], self._taken.clone().reshape(*tensordict.batch_size, *self.shape))

    def _rows(self, mask: Tensor | None) -> Tensor:
        count = len(base_env(self).row_tasks)  # type: ignore[union-attr]
        return torch.ones(count, dtype=torch.bool) if mask is None else mask.reshape(count).cpu()

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        which = self._rows(tensordict.get("_reset", None))
        self._steps = reset_rows(self._steps, torch.zeros(len(which), dtype=torch.int64), which)
        return self._draw(which, tensordict_reset)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        moved = self._rows(tensordict.get("_step", None))
        self._steps = begun(self._steps) + moved
        return self._draw(moved & (self._steps % self.every == 0), next_tensordict)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        raise ValueError("CameraTransform renders an environment; for a dataset use add_pictures and load_pictures")

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        shape = (*observation_spec.shape, *self.shape)
        observation_spec[self.out_keys[0]] = UnboundedDiscrete(shape, dtype=torch.uint8, device=observation_spec.device)
        return observation_spec


class LanguageInstruction(Transform):
    """A transform that writes the task description, such as "Push the puck to the target location.".

    Works in environments and replay buffers. Reads ``task_id`` (B,) int64; writes ``language_instruction``, one string
    for each row, which policies such as ``torchrl.modules.VLAWrapperBase`` read. Strings make an environment step 1.15
    to 2.5 times slower, so :class:`~lw_torchrl.LanguageWorldEnv` does not write them itself.

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

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        shape, device = observation_spec.shape, observation_spec.device
        example = next(iter(self._texts.values())).data
        observation_spec[self.out_keys[0]] = NonTensor(shape, example_data=example, device=device)
        return observation_spec


class SuiteTransform(Transform):
    """A transform that writes a layout's ``observation`` and the ``task_id`` in any TorchRL environment.

    :class:`QAFTransform`, actors, collectors and losses then work as with :class:`~lw_torchrl.LanguageWorldEnv`.

    Reads ``in_keys``; writes ``observation`` (..., D) float32 and ``task_id`` (...) int64. If the layout
    contains values of the previous time step, the transform fills them in (at a reset, with the current values). With
    ``act``, ``action`` (..., A) float32 in [-1, 1] is an action of the layout.

    Args:
        task: the task, whose layout has D numbers and A actions.
        observe: a function that maps the tensors of ``in_keys`` to (..., D) numbers in the layout's order and frame;
            the numbers of the previous time step are overwritten.
        act: a function that maps an action of the layout (..., A) to an action of the environment; None for no change.
        in_keys: the keys that ``observe`` reads.

    Raises:
        ValueError: at call time, a key is missing, or ``observe`` does not return D numbers.

    Example:
        >>> import lw_torchrl as lw, torch
        >>> from lw_torchrl.transforms import SuiteTransform
        >>> from torchrl.envs import TransformedEnv
        >>> env = TransformedEnv(lw.LanguageWorldEnv("reach"), SuiteTransform(lw.TASKS["push"], lambda seen: seen))
        >>> env.reset()["observation"].shape
        torch.Size([1, 39])

    Source: ``torchrl.envs.transforms.CatTensors``, with a fixed order of the values.
    """

    makes_observation = True

    @typed
    def __init__(
        self,
        task: Task,
        observe: Callable[..., Tensor],
        *,
        act: Callable[[Tensor], Tensor] | None = None,
        in_keys: Keys = ("observation",),
    ) -> None:
        inverse, written = ["action"] if act is not None else [], ["observation", "task_id"]
        super().__init__(in_keys=list(in_keys), out_keys=written, in_keys_inv=inverse, out_keys_inv=inverse)
        self.task, self.observe, self.act, self.layout = task, observe, act, task.layout

    def _seen(self, tensordict: TensorDictBase) -> Tensor:
        observation = self.observe(*read(tensordict, self.in_keys)).to(torch.float32)
        if observation.shape[-1:] != (self.layout.size,):
            numbers = f"the {self.layout.size} numbers of layout {self.layout.name!r}"
            raise ValueError(f"observe must return {numbers}, got shape {tuple(observation.shape)}")
        return observation.clone()  # observe may return the environment's own tensor

    def _write(self, tensordict: TensorDictBase, before: Tensor | None) -> TensorDictBase:
        seen, past = self._seen(tensordict), self.layout.past
        if past is not None:
            seen[..., past : 2 * past] = (seen if before is None else before)[..., :past]
        number = torch.full(seen.shape[:-1], task_id(self.task.name), device=seen.device)
        return tensordict.set("observation", seen).set("task_id", number)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._write(tensordict_reset, None)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._write(next_tensordict, tensordict.get("observation"))

    def _inv_apply_transform(self, action: Tensor) -> Tensor:
        assert self.act is not None
        return self.act(action)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        shape, device = observation_spec.shape, observation_spec.device
        observation_spec["observation"] = Unbounded((*shape, self.layout.size), device=device, dtype=torch.float32)
        observation_spec["task_id"] = Unbounded(shape, device=device, dtype=torch.int64)
        return observation_spec

    def transform_action_spec(self, action_spec: TensorSpec) -> TensorSpec:
        if self.act is None:
            return action_spec
        if isinstance(action_spec, Composite):
            action_spec["action"] = self.transform_action_spec(action_spec["action"])
            return action_spec
        shape = (*action_spec.shape[:-1], self.layout.action_size)
        return Bounded(-1.0, 1.0, shape, device=action_spec.device, dtype=torch.float32)
