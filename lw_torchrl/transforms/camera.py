"""CameraTransform: camera pictures of an environment's rows as observations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, UnboundedDiscrete
from torchrl.envs import EnvBase, Transform
from torchrl.envs.batched_envs import BatchedEnvBase

from lw_torchrl._util.checks import Count, typed
from lw_torchrl._util.keys import Keys, as_keys
from lw_torchrl._util.rendering import check_cameras
from lw_torchrl.transforms.environment import KeepsEnvState, base_env, reset_rows


class CameraTransform(KeepsEnvState):
    """A transform that writes ``pixels`` (B, height, width·C, 3) uint8, the pictures of C cameras from left to right.

    A row is rendered at its reset and then every N time steps of its episode; its picture stays the same in between.
    Rows outside a ``_step`` or ``_reset`` mask are not rendered. The ``state_dict`` includes that of the environment,
    as for :class:`EnvState`. With SerialEnv and ParallelEnv, put this transform into each worker.

    Args:
        cameras: one or several of "corner2", "corner", "corner3", "corner4", "topview", "behindGripper", "gripperPOV".
        height, width: size of each picture, in pixels.
        every: N, the number of time steps between two pictures.
        out_keys: a replacement for the key ``pixels``.

    Raises:
        ValueError: a camera is unknown, a picture is too large, or the transform is used on a replay buffer.
        TypeError: the base environment is not a LanguageWorldEnv.
        RuntimeError: the environment takes a step without a reset, or without a reset since ``load_state_dict``.
        ImportError: OpenGL is missing; the message names what to install.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> import lw_torchrl as lw
        >>> env = TransformedEnv(lw.LanguageWorldEnv("reach"), lw.transforms.CameraTransform(("corner", "corner3")))
        >>> env.reset()["pixels"].shape
        torch.Size([1, 64, 128, 3])

    Source: ``torchrl.record.PixelRenderTransform``, for selected rows and time steps.
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
        if isinstance(env, BatchedEnvBase):
            raise TypeError(f"CameraTransform must be in each worker of a {type(env).__name__}, not around it")
        if env is not None and not hasattr(env, "row_tasks"):
            raise TypeError(f"CameraTransform needs a LanguageWorldEnv, got {type(env).__name__}")

    def _draw(self, which: Tensor, tensordict: TensorDictBase) -> TensorDictBase:
        """Re-render the images of the rows selected by the boolean mask ``which`` (N,), then write the images of all N
        rows.
        """
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
        env: Any = base_env(self)
        count = len(env.row_tasks)
        return torch.ones(count, dtype=torch.bool) if mask is None else mask.reshape(count).cpu()

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        begun = self._rows(tensordict.get("_reset", None))
        self._steps = reset_rows(self._steps, torch.zeros(len(begun), dtype=torch.int64), begun)
        return self._draw(begun, tensordict_reset)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        if self._steps is None:
            raise RuntimeError("no episode has begun: reset the environment before the first step")
        moved = self._rows(tensordict.get("_step", None))
        self._steps = self._steps + moved
        return self._draw(moved & (self._steps % self.every == 0), next_tensordict)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        raise ValueError(
            "CameraTransform renders an environment; for a dataset use lw.data.add_pictures(root, ...), then "
            "replay.add_column('pixels', lw.data.load_pictures(replay, ...))"
        )

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        assert isinstance(observation_spec, Composite)
        shape = (*observation_spec.shape, *self.shape)
        observation_spec[self.out_keys[0]] = UnboundedDiscrete(shape, dtype=torch.uint8, device=observation_spec.device)
        return observation_spec
