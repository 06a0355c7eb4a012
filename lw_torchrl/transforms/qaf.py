"""QAFTransform: the truth of each condition of the task's plan, as a tensor."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from torchrl.data import Binary, Composite, TensorSpec
from torchrl.envs import EnvBase, Transform, TransformedEnv
from torchrl.envs.batched_envs import BatchedEnvBase

from lw_torchrl._checks import missing_keys
from lw_torchrl.language.plans import ConditionalPlan, Plans, as_plans
from lw_torchrl.language.query_program import QueryProgram


def plan_program(plans: Plans) -> QueryProgram:
    """The conditions of ``plans`` as one :class:`QueryProgram`, a column for each step."""
    return QueryProgram({plan.definition: [step.condition for step in plan.steps] for plan in plans.values()})


class QAFTransform(Transform):
    """Writes ``qaf``, in an environment and on a replay buffer.

    Reads ``observation`` (B, 39) float32 and ``task_id`` (B,) int64; writes ``qaf`` (B, S) bool, the truth of each
    condition of the row's plan, in the order of its steps, false beyond its last. On a replay buffer it writes
    ``("next", "qaf")`` too, wherever ``("next", "observation")`` is.

    Args:
        plans: a plan for each task that will be seen.

    Raises:
        PlanError: (a ValueError) the environment has a task without a plan.
        ValueError: a task_id without a plan, or a malformed observation.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> import lw_torchrl as lw
        >>> env = TransformedEnv(lw.LanguageWorldEnv("reach"), lw.QAFTransform(lw.load_plans("MT10")))
        >>> env.reset()["qaf"].dtype
        torch.bool
        >>> env.close()

    Source: paper section 'Query Answering Function'.
    """

    def __init__(self, plans: Plans | Mapping[str, ConditionalPlan], in_keys=None, out_keys=None) -> None:
        super().__init__(in_keys=["observation"], out_keys=["qaf"])
        self.plans = as_plans(plans)
        self.program = plan_program(self.plans)

    def _write(self, tensordict: TensorDictBase, task_ids: TensorDictBase) -> None:
        observation, task_id = tensordict.get("observation", None), task_ids.get("task_id", None)
        if observation is None or task_id is None:
            raise missing_keys(tensordict.keys(), "observation", "task_id")
        tensordict.set("qaf", self.program(observation, task_id))

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._write(next_tensordict, next_tensordict)
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``qaf``, and ``("next", "qaf")`` where there is a next observation."""
        self._write(tensordict, tensordict)
        if ("next", "observation") in tensordict.keys(True):
            following = tensordict.get("next")
            self._write(following, following if "task_id" in following.keys() else tensordict)
        return tensordict

    def set_container(self, container: Transform | EnvBase) -> None:
        """Join an environment, every task of which must have a plan."""
        super().set_container(container)
        try:
            env = self.container
        except ValueError:  # a Compose that is in no environment, or not yet
            return
        while isinstance(env, TransformedEnv):
            env = env.base_env
        if not isinstance(env, BatchedEnvBase):  # whose workers may not be there yet
            self.plans.require(getattr(env, "tasks", ()))

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add ``qaf`` to the specs."""
        assert isinstance(observation_spec, Composite)
        steps = self.program.num_queries
        observation_spec["qaf"] = Binary(
            steps, shape=(*observation_spec.shape, steps), dtype=torch.bool, device=observation_spec.device
        )
        return observation_spec
