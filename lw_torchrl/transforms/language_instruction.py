"""LanguageInstruction: the description of each row's task, for policies that read language."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tensordict import NonTensorData, NonTensorStack, TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import Composite, NonTensor, TensorSpec
from torchrl.envs import Transform

from lw_torchrl._util.checks import typed
from lw_torchrl._util.keys import as_keys, read
from lw_torchrl.language.tasks import TASKS, TaskList, named_tasks, task_id
from lw_torchrl.transforms.environment import base_env


class LanguageInstruction(Transform):
    """Write ``language_instruction``, the description of each row's task: "Push the puck to the target location."

    Policies such as ``torchrl.modules.VLAWrapperBase`` read it. For environments and replay buffers. Reads ``task_id``
    (B,) int64; writes one string for each row. Strings make a step of an environment 1.15 to 2.5 times slower,
    therefore :class:`~lw_torchrl.LanguageWorldEnv` does not write them itself.

    Args:
        tasks: the tasks whose descriptions are written, as for :class:`~lw_torchrl.LanguageWorldEnv`, or plans for
            them; None for the 50, and those of the environment.
        in_keys, out_keys: other names for task_id and language_instruction.

    Raises:
        ValueError: at call time, a task that is not among ``tasks``.

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
        self,
        tasks: TaskList | None = None,
        *,
        in_keys: Sequence[NestedKey] | None = None,
        out_keys: Sequence[NestedKey] | None = None,
    ) -> None:
        super().__init__(
            in_keys=as_keys("in_keys", in_keys, ("task_id",)),
            out_keys=as_keys("out_keys", out_keys, ("language_instruction",)),
        )
        known = TASKS.values() if tasks is None else named_tasks(tasks).values()
        self._texts = {task_id(task.name): NonTensorData(task.description) for task in known}

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        (ids,) = read(next_tensordict, self.in_keys)
        shape = next_tensordict.batch_size
        texts = [self._text(number) for number in ids.reshape(-1).tolist()]
        value: Any = texts[0] if not shape else NonTensorStack(*texts).reshape(shape)
        return next_tensordict.set(self.out_keys[0], value)

    def _text(self, number: int) -> NonTensorData:
        if number not in self._texts:
            for task in getattr(base_env(self), "task_of_row", ()):
                self._texts.setdefault(task_id(task.name), NonTensorData(task.description))
        if number not in self._texts:
            raise ValueError(f"task_id {number} is not among the tasks of LanguageInstruction: give it tasks=")
        return self._texts[number]

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
