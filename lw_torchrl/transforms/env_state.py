"""EnvState: the environment's seed and episode counters, in the state_dict of its transforms."""

from __future__ import annotations

import io
import warnings

import torch
from torch import Tensor
from torchrl.envs import Transform
from torchrl.envs.batched_envs import BatchedEnvBase

from lw_torchrl.transforms.containers import base_env


class KeepsEnvState(Transform):
    """A transform whose ``state_dict`` holds that of the environment under it, for TorchRL asks no one else."""

    def get_extra_state(self) -> Tensor:
        """The environment's ``state_dict``, as bytes (n,) uint8; empty on a replay buffer."""
        env = base_env(self)
        if env is None:
            return torch.zeros(0, dtype=torch.uint8)
        if isinstance(env, BatchedEnvBase) and env.is_closed:
            warnings.warn(
                f"this {type(env).__name__} is not running, so the state_dict says nothing of its episodes",
                stacklevel=2,
            )
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

    A TransformedEnv's ``state_dict`` is that of its transforms alone: without this one, or a :class:`QAFTransform`,
    which does the same, a collector that is resumed would run the same episodes again. Changes no entry. After
    ``load_state_dict`` the environment must be reset (``collector.reset()``). Put it around a ParallelEnv too: the
    ``load_state_dict`` of a ParallelEnv alone leaves TorchRL 0.14.1 one answer behind, unless it has
    ``use_buffers=False``; this one mends that.

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
