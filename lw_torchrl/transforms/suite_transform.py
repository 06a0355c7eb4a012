"""SuiteTransform: convert the observations and actions of any environment to those of a layout."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded
from torchrl.envs import Transform

from lw_torchrl._util.checks import typed
from lw_torchrl._util.keys import Keys, read
from lw_torchrl.language.tasks import Task, task_id


class SuiteTransform(Transform):
    """A transform that writes a layout's ``observation`` and the ``task_id`` in any TorchRL environment.

    :class:`QAFTransform`, actors, collectors and losses then work as with :class:`~lw_torchrl.LanguageWorldEnv`.

    Reads ``in_keys``; writes ``observation`` (..., D) float32 and ``task_id`` (...) int64. If the layout
    contains the previous time step's numbers, the transform fills them in (at a reset, with the current numbers). With
    ``act``, ``action`` (..., A) float32 in [-1, 1] is an action of the layout.

    Args:
        task: the task, whose layout has D numbers and A actions.
        observe: a function that maps the tensors of ``in_keys`` to (..., D) numbers in the layout's order and frame;
            the numbers of the previous time step are overwritten.
        act: a function that maps an action of the layout (..., A) to one of the environment; None for the identity.
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

    Source: ``torchrl.envs.transforms.CatTensors``, with a fixed order of numbers.
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

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        assert isinstance(observation_spec, Composite)
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
