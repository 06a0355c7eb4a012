"""QAFTransform: answer the conditions of each row's plan, as a tensor of their truth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Binary, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase, Transform
from torchrl.envs.batched_envs import BatchedEnvBase

from lw_torchrl._util.checks import missing_keys, typed
from lw_torchrl._util.keys import as_keys, check_apart, key_beside
from lw_torchrl.language.plans import AnyPlans, Plans, as_plans
from lw_torchrl.language.query_program import QueryProgram
from lw_torchrl.language.task_index import PlanTables, TaskTables, one_per_row
from lw_torchrl.transforms.environment import KeepsEnvState, base_env, refuse_changed, reset_rows

_HALF = (torch.float16, torch.bfloat16)  # in which metres are not told apart as conditions do


class _Number(NamedTuple):
    plan: Tensor  # (T,) int64


def plan_program(plans: Plans) -> QueryProgram:
    """The conditions of ``plans`` as one :class:`QueryProgram`, a column for each step."""
    return QueryProgram({plan.definition: [step.condition for step in plan.steps] for plan in plans.values()})


def plan_number_key(qaf: NestedKey) -> NestedKey:
    """Where :class:`QAFTransform` writes the plan's number: beside ``qaf``, ``qaf_plan``."""
    return key_beside(qaf, "_plan")


class QAFTransform(KeepsEnvState):
    """Answer the conditions of each row's plan, in an environment and on a replay buffer.

    Reads ``observation`` (B, 39) float32 and ``task_id`` (B,) int64; writes ``qaf`` (B, S) bool, the truth of each
    condition of the row's plan, in the order of its steps, false beyond its last, and ``qaf_plan`` (B,) int64, that
    plan's number in :attr:`Plans.numbers`, by which an actor of other plans refuses the answers. On a replay buffer it
    writes ``("next", "qaf")`` too, wherever ``("next", "observation")`` is. In an environment its ``state_dict`` holds
    the environment's, as :class:`EnvState` does.

    Conditions are about metres, so put it before transforms that change the observation, such as a normaliser or
    :class:`RandomYaw`: one before it is refused, except in the workers of a SerialEnv or ParallelEnv.

    Args:
        plans: a plan for each task that will be seen.
        in_keys: other names for observation and task_id, in this order.
        out_keys: another name for qaf; the plan's number gets this name and ``_plan``.

    Raises:
        PlanError: (a ValueError) the environment has a task without a plan.
        ValueError: a wrong argument, a task_id without a plan, a malformed observation, one of half precision, or a
            transform before it that changes it.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> import lw_torchrl as lw
        >>> env = TransformedEnv(lw.LanguageWorldEnv("reach"), lw.QAFTransform(lw.load_plans("MT10")))
        >>> env.reset()["qaf"].dtype
        torch.bool

    Source: paper section 'Query Answering Function'.
    """

    @typed
    def __init__(
        self,
        plans: AnyPlans,
        *,
        in_keys: Sequence[NestedKey] | None = None,
        out_keys: Sequence[NestedKey] | None = None,
    ) -> None:
        truth = as_keys("out_keys", out_keys, ("qaf",))
        keys = as_keys("in_keys", in_keys, ("observation", "task_id"))
        super().__init__(in_keys=keys, out_keys=[*truth, plan_number_key(truth[0])])
        check_apart(self.in_keys, self.out_keys)
        self.plans = as_plans(plans)
        self.program = plan_program(self.plans)
        tables = PlanTables(self.plans)
        self._number = TaskTables(tables.index, _Number(tables.number), f"tasks without a plan in {self.plans!r}")
        self._task: Tensor | None = None  # of each row, since its last reset

    def with_plans(self, plans: AnyPlans) -> QAFTransform:
        """Return a transform that answers the conditions of other plans."""
        return QAFTransform(plans, in_keys=self.in_keys, out_keys=self.out_keys[:1])

    def _write(self, tensordict: TensorDictBase, task_id: Tensor | None) -> None:
        observation = tensordict.get(self.in_keys[0], None)
        if observation is None or task_id is None:
            raise missing_keys(tensordict.keys(True, True), *map(str, self.in_keys))
        if observation.dtype in _HALF:
            got = f"got {observation.dtype}: put QAFTransform before what casts it"
            raise ValueError(f"observation must be float32 or float64, {got}")
        task_id = one_per_row(task_id, observation)
        tensordict.set(self.out_keys[0], self.program(observation, task_id))
        number = self._number.select(task_id.reshape(-1), observation).plan
        tensordict.set(self.out_keys[1], number.reshape(task_id.shape).clone())  # a collector zeroes what it is given

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._write(next_tensordict, next_tensordict.get(self.in_keys[1], None))
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        begun, task = tensordict.get("_reset", None), tensordict_reset.get(self.in_keys[1], None)
        self._task = task if task is None else reset_rows(self._task, task, begun)
        self._write(tensordict_reset, self._task)
        return tensordict_reset

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        observation, task = self.in_keys
        task_id = tensordict.get(task, None)
        self._write(tensordict, task_id)
        following = tensordict.get("next", None)
        if following is not None and following.get(observation, None) is not None:
            self._write(following, following.get(task, task_id))
        return tensordict

    def set_container(self, container: Transform | EnvBase) -> None:
        super().set_container(container)
        refuse_changed(self, self.in_keys[0])
        env = base_env(self)
        if not isinstance(env, BatchedEnvBase):  # whose workers may not be there yet
            self.plans.require(getattr(env, "tasks", ()))

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        assert isinstance(observation_spec, Composite)
        refuse_changed(self, self.in_keys[0])  # a transform may have been inserted before it
        steps, shape, device = self.program.num_queries, observation_spec.shape, observation_spec.device
        observation_spec[self.out_keys[0]] = Binary(steps, shape=(*shape, steps), dtype=torch.bool, device=device)
        observation_spec[self.out_keys[1]] = Unbounded(shape, dtype=torch.int64, device=device)
        return observation_spec
