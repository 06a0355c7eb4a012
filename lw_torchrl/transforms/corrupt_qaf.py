"""CorruptQAF: query answers that are updated rarely, delayed or wrong."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, TensorSpec

from lw_torchrl._checks import Count, Natural, Probability, checked, missing_keys
from lw_torchrl._keys import as_keys, read
from lw_torchrl._seeding import episode_generator
from lw_torchrl.language.plans import AnyPlans, Plans, as_plans
from lw_torchrl.language.task_index import PlanTables
from lw_torchrl.transforms.environment import EpisodeTransform, reset_rows
from lw_torchrl.transforms.qaf import plan_number_key

_BLOCK = 64  # steps of an episode whose random numbers are drawn together


class CorruptQAF(EpisodeTransform):
    """Corrupt ``qaf`` in an environment, after a :class:`QAFTransform`, to measure the cost of slow and wrong answers.

    Reads ``qaf`` (B, S) bool, ``task_id`` (B,) and ``episode`` (B,) int64, and ``qaf_plan`` (B,) int64 where it is;
    writes only ``qaf``. The corruptions are applied in this order:

    - **every, delay**: in step t of its episode, 0 at the reset, a row is shown the answers of step
      every · ⌊max(t - delay, 0) / every⌋;
    - **flip**: in each step, the reset included, each answer is inverted with this probability.

    The random draws depend only on (task, seed, episode, step) and the answer's place in its plan. A greater
    probability inverts all that a smaller one inverts. In :func:`lw_torchrl.evaluate` it is an ``evaluator``. A policy
    with its own :class:`QueryEvaluator` does not read ``qaf`` and is not affected.

    Args:
        plans: whose conditions ``qaf`` answers.
        every, delay: steps between two updates of a row's answers, and steps until they are shown.
        flip: a probability.
        seed: any integer, of the random draws.
        in_keys: where qaf, task_id and episode are, in this order; qaf is written where it was.

    Raises:
        ValueError: ``qaf`` is missing, has another shape or dtype, or belongs to other plans; or the transform is used
            in a replay buffer, whose rows do not record the steps of their episodes.
        RuntimeError: a step of an environment that was never reset, or not since ``load_state_dict``.

    Example:
        >>> import lw_torchrl as lw
        >>> plans = lw.load_plans("MT10")
        >>> actor, noisy = lw.ScriptedSkillActor(plans), lw.CorruptQAF(plans, every=2, flip=0.05)
        >>> lw.evaluate(actor, tasks="reach", episodes_per_task=2, seed=1_000, evaluator=noisy).success_once
        {'reach': 1.0}

    Source: the paper names a visual question answering model as a query answering function; such a model errs.
    """

    @checked
    def __init__(
        self,
        plans: AnyPlans,
        *,
        every: Count = 1,
        delay: Natural = 0,
        flip: Probability = 0.0,
        seed: int = 0,
        in_keys: Sequence[NestedKey] | None = None,
    ) -> None:
        keys = as_keys("in_keys", in_keys, ("qaf", "task_id", "episode"))
        super().__init__(in_keys=keys, out_keys=keys[:1])
        self.plans = as_plans(plans)
        self.every, self.delay, self.flip, self.seed = every, delay, flip, seed
        self._tables = PlanTables(self.plans)
        self._task: Tensor | None = None  # B int64, of the rows' episodes
        self._episode: Tensor | None = None
        self._plan = torch.empty(0, dtype=torch.int64)  # B int64, where their plans are in the tables
        self._forget_episodes()

    def _forget_episodes(self) -> None:
        self._places = -(-self.delay // self.every) + 1  # maximum number of answers waiting to be shown
        self._steps: Tensor | None = None  # B int64, of each row's episode
        self._taken: Tensor | None = None  # (B, places, S) bool; the n-th answers are in place n % places
        self._draws = _Draws(self.seed, self._tables, self.plans)

    def with_plans(self, plans: AnyPlans) -> CorruptQAF:
        """Return a transform that corrupts the answers of other plans alike."""
        same = {name: getattr(self, name) for name in ("every", "delay", "flip", "seed", "in_keys")}
        return CorruptQAF(plans, **same)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        truth, task, episode = read(tensordict_reset, self.in_keys)
        begun = tensordict.get("_reset", None)
        self._task, self._episode = reset_rows(self._task, task, begun), reset_rows(self._episode, episode, begun)
        self._plan = self._tables.rows(self._task)
        number = tensordict_reset.get(plan_number_key(self.in_keys[0]), None)
        if number is not None and bool(((number != self._tables.number[self._plan]) & (number != 0)).any()):
            raise ValueError("qaf answers other plans than CorruptQAF was given: give both the same plans")
        shape = (*self._plan.shape, self.plans.num_steps)
        if truth.dtype != torch.bool or truth.shape != shape:
            raise ValueError(f"qaf must be bool of shape {shape}, got {truth.dtype} of shape {tuple(truth.shape)}")
        self._steps = reset_rows(self._steps, torch.zeros_like(self._plan), begun)
        self._taken = reset_rows(self._taken, torch.stack([truth] * self._places, -2), begun, 2)
        return self._show(tensordict_reset)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        if self._steps is None or self._taken is None:
            raise RuntimeError("rows have begun no episode, or not since load_state_dict: reset the environment")
        moved = tensordict.get("_step", None)
        moved = torch.ones_like(self._steps, dtype=torch.bool) if moved is None else moved.reshape(self._steps.shape)
        self._steps = self._steps + moved
        due = moved & (self._steps % self.every == 0)
        place = torch.arange(self._places, device=due.device) == self._place(self._steps).unsqueeze(-1)
        truth = next_tensordict.get(self.in_keys[0]).unsqueeze(-2)
        self._taken = torch.where((place & due.unsqueeze(-1)).unsqueeze(-1), truth, self._taken)
        return self._show(next_tensordict)

    def _place(self, step: Tensor) -> Tensor:
        return step // self.every % self._places

    def _show(self, tensordict: TensorDictBase) -> TensorDictBase:
        assert self._steps is not None
        assert self._taken is not None
        assert self._episode is not None
        place = self._place((self._steps - self.delay).clamp(min=0))[..., None, None]
        shown = self._taken.gather(-2, place.expand(*place.shape[:-1], self._taken.shape[-1])).squeeze(-2)
        if self.flip:
            shown = shown ^ (self._draws(self._plan, self._episode, self._steps) < self.flip)
        return tensordict.set(self.in_keys[0], shown)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        raise ValueError(
            "CorruptQAF counts the steps of an environment's episodes, which rows of a replay buffer do not tell: put "
            "it into the environment, behind QAFTransform, or give it to evaluate(evaluator=...)"
        )

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        assert isinstance(observation_spec, Composite)
        keys = list(observation_spec.keys(True, True))
        if any(key not in keys for key in self.in_keys):
            raise missing_keys(keys, *map(str, self.in_keys))
        return observation_spec


class _Draws:
    """Uniform numbers for the answers of rows, in blocks of steps, by (task, seed, episode, block); 1 on padding."""

    def __init__(self, seed: int, tables: PlanTables, plans: Plans) -> None:
        self._seed = seed
        self._plans = [plans[task] for task in tables.index.tasks]
        self._width = plans.num_steps
        self._which = torch.empty(0, 3, dtype=torch.int64)  # the row of the tables, episode and block of each row
        self._drawn = torch.empty(0, _BLOCK, self._width)

    def __call__(self, rows: Tensor, episode: Tensor, step: Tensor) -> Tensor:
        """Rows of the tables, their episodes and their steps, each B int64, to (B, S) float64 in [0, 1]."""
        which = torch.stack([one.reshape(-1).cpu() for one in (rows, episode, step // _BLOCK)], -1)
        if which.shape != self._which.shape:
            self._which = torch.full_like(which, -1)
            self._drawn = torch.ones(len(which), _BLOCK, self._width, dtype=torch.float64)
        if not torch.equal(which, self._which):
            for place in (which != self._which).any(-1).nonzero().flatten().tolist():
                row, number, block = which[place].tolist()
                if number < 0:  # never reset
                    continue
                plan = self._plans[row]
                drawn = episode_generator(f"answers/flip/{block}", plan.definition, self._seed, number)
                steps = len(plan.steps)
                self._drawn[place, :, :steps] = torch.from_numpy(drawn.random((_BLOCK, steps)))
            self._which = which
        numbers = self._drawn[torch.arange(len(which)), step.reshape(-1).cpu() % _BLOCK]
        return numbers.reshape(*step.shape, -1).to(step.device)
