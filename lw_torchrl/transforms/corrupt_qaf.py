"""CorruptQAF: make query answers late, held or wrong."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, TensorSpec

from lw_torchrl._util.checks import Count, Natural, Probability, missing_keys, typed
from lw_torchrl._util.keys import as_keys, read
from lw_torchrl._util.reproducibility import episode_generator
from lw_torchrl.language.plans import AnyPlans, Plans, as_plans
from lw_torchrl.language.task_index import PlanTables
from lw_torchrl.transforms.environment import EpisodeTransform, reset_rows
from lw_torchrl.transforms.qaf import plan_number_key

_BLOCK = 64  # steps of an episode whose random numbers are drawn together


class CorruptQAF(EpisodeTransform):
    """Make the answers in ``qaf`` late, held and wrong, to measure what slow or unreliable answers cost.

    For environments, after a :class:`QAFTransform`. Reads ``qaf`` (B, S) bool, or float in [0, 1], ``task_id`` (B,) and
    ``episode`` (B,) int64, and ``qaf_plan`` (B,) int64 where it exists; changes only ``qaf``:

    - **every, delay** (held, late): in step t of its episode, 0 at the reset, a row shows the answers of step
      every · ⌊max(t - delay, 0) / every⌋;
    - **flip** (wrong): in each step, the reset included, each answer is then inverted with this probability.

    The draws depend only on (task, seed, episode, step) and the answer's place in its plan; a larger probability
    inverts all that a smaller one inverts. In :func:`lw_torchrl.evaluate` it can be the ``evaluator``. To corrupt a
    learned evaluator's answers, put a transform before this one that calls the evaluator in ``_reset`` and ``_call``.

    Args:
        plans: the plans whose conditions ``qaf`` answers.
        every: steps between two updates of a row's answers.
        delay: steps until new answers are shown.
        flip: probability of inverting an answer.
        seed: any integer, for the random draws.
        in_keys: other names for qaf, task_id and episode, in this order.

    Raises:
        ValueError: ``qaf`` is missing, or of another shape, dtype or plan; or the transform is used in a replay buffer.
        RuntimeError: a step of an environment that was never reset, or not since ``load_state_dict``.

    Example:
        >>> import lw_torchrl as lw
        >>> plans = lw.load_plans("MT10")
        >>> actor, noisy = lw.ScriptedSkillActor(plans), lw.CorruptQAF(plans, every=2, flip=0.05)
        >>> lw.evaluate(actor, tasks="reach", episodes_per_task=2, seed=1_000, evaluator=noisy).success_once
        {'reach': 1.0}

    Source: the paper names a visual question answering model as a query answering function; such a model errs.
    """

    @typed
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
        self._taken: Tensor | None = None  # (B, places, S); the n-th answers are in place n % places
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
        self._tables.refuse_others(tensordict_reset.get(plan_number_key(self.in_keys[0]), None), self._plan)
        shape = (*self._plan.shape, self.plans.num_steps)
        if truth.shape != shape or not (truth.dtype == torch.bool or truth.is_floating_point()):
            got = f"{truth.dtype} of shape {tuple(truth.shape)}"
            raise ValueError(f"qaf must be bool, or float for soft truth, of shape {shape}, got {got}")
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
            wrong = self._draws(self._plan, self._episode, self._steps) < self.flip
            shown = shown ^ wrong if shown.dtype == torch.bool else torch.where(wrong, 1 - shown, shown)
        return tensordict.set(self.in_keys[0], shown)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        raise ValueError(
            "CorruptQAF counts the steps of an environment's episodes, which rows of a replay buffer do not record: "
            "put it into the environment, after QAFTransform, or give it to evaluate(evaluator=...)"
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
