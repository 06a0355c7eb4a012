"""CorruptQAF: query answers that are taken rarely, come late, or are wrong."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, TensorSpec

from lw_torchrl._checks import check_int, check_probability, checked, missing_keys, shown, unknown_name
from lw_torchrl._keys import as_keys, read
from lw_torchrl._seeding import episode_generator
from lw_torchrl.language.plans import AnyPlans, Plans, as_plans
from lw_torchrl.language.queries import Query, read_query
from lw_torchrl.language.task_index import PlanTables
from lw_torchrl.transforms.environment import EpisodeTransform, reset_rows
from lw_torchrl.transforms.qaf import plan_number_key

_BLOCK = 64  # steps of an episode whose draws are made at once


class CorruptQAF(EpisodeTransform):
    """Corrupt ``qaf`` in an environment, after a :class:`QAFTransform`, to measure the cost of slow and wrong answers.

    Reads ``qaf`` (B, S) bool, ``task_id`` (B,) and ``episode`` (B,) int64, and ``qaf_plan`` (B,) int64 where it is;
    writes only ``qaf``. The corruptions are applied in this order:

    - **every, delay**: in step t of its episode, 0 at the reset, a row is shown the answers of step
      every · ⌊max(t - delay, 0) / every⌋;
    - **stick**: in each step each answer stays, with this probability, what it was the step before;
    - **flip**: in each step, the reset's state included, each answer is shown as its opposite, with this probability;
      what sticks is the answer itself, not its opposite;
    - **drop**: the answers to these queries are always false.

    What is drawn for an answer depends only on (task, seed, episode, step) and the answer's place in its plan. Of two
    probabilities the greater one spoils what the smaller one spoils, and more. In :func:`lw_torchrl.evaluate` it is an
    ``evaluator``. A policy with a :class:`QueryEvaluator` of its own does not read ``qaf``, and feels nothing.

    Args:
        plans: whose conditions ``qaf`` answers.
        every, delay: steps between two updates of a row's answers, and steps until they are shown.
        flip, stick: probabilities, from 0 to 1.
        drop: conditions of the plans in any spelling, each dropped in all plans that have it.
        seed: any integer, of what is drawn.
        in_keys: where qaf, task_id and episode are, in this order; qaf is written where it was.

    Raises:
        ValueError: a wrong argument, a query that no plan has (with the nearest), ``qaf`` that is absent, of another
            shape or dtype, or of other plans, or a replay buffer, whose rows do not tell the steps of their episodes.
        RuntimeError: a step of an environment that was never reset, or not since ``load_state_dict``.

    Example:
        >>> import lw_torchrl as lw
        >>> plans = lw.load_plans("MT10")
        >>> noisy = lw.CorruptQAF(plans, every=2, flip=0.05, drop=["the gripper is near the reach target"])
        >>> actor = lw.ScriptedSkillActor(plans)
        >>> lw.evaluate(actor, tasks="reach", episodes_per_task=2, seed=1_000, evaluator=noisy).success_once
        {'reach': 1.0}

    Source: the paper names a visual question answering model as a query answering function; such a one errs.
    """

    @checked
    def __init__(
        self,
        plans: AnyPlans,
        *,
        every: int = 1,
        delay: int = 0,
        flip: float = 0.0,
        stick: float = 0.0,
        drop: Iterable[str | Query] = (),
        seed: int = 0,
        in_keys: Sequence[NestedKey] | None = None,
    ) -> None:
        keys = as_keys("in_keys", in_keys, ("qaf", "task_id", "episode"))
        super().__init__(in_keys=keys, out_keys=keys[:1])
        self.plans = as_plans(plans)
        self.flip, self.stick = check_probability("flip", flip), check_probability("stick", stick)
        self.every, self.delay = check_int("every", every, minimum=1), check_int("delay", delay, minimum=0)
        self.seed = check_int("seed", seed)
        self.drop = _as_texts(drop)
        self._tables = PlanTables(self.plans)
        self._answered = self._tables.mask.clone()
        for text in self.drop:
            if not (dropped := _steps_with(text, self._tables, self.plans)).any():
                conditions = {str(step.condition) for plan in self.plans.values() for step in plan.steps}
                raise unknown_name("drop", text, sorted(conditions))
            self._answered &= ~dropped
        self._task: Tensor | None = None  # B int64, of the rows' episodes
        self._episode: Tensor | None = None
        self._plan = torch.empty(0, dtype=torch.int64)  # B int64, where their plans are in the tables
        self._forget_episodes()

    def _forget_episodes(self) -> None:
        self._rows = _DelayedAnswers(self.every, self.delay)
        self._draws = {purpose: _Draws(purpose, self.seed, self._tables, self.plans) for purpose in ("stick", "flip")}

    def with_plans(self, plans: AnyPlans) -> CorruptQAF:
        """Return a transform that corrupts the answers of other plans alike; queries that they lack are not dropped."""
        other = as_plans(plans)
        dropped = [text for text in self.drop if _steps_with(text, PlanTables(other), other).any()]
        same = {name: getattr(self, name) for name in ("every", "delay", "flip", "stick", "seed", "in_keys")}
        return CorruptQAF(other, drop=dropped, **same)

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
        return tensordict_reset.set(self.in_keys[0], self._spoilt(self._rows.begin(truth, begun)))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        stuck = (lambda: self._drawn("stick") < self.stick) if self.stick else None
        now = self._rows.advance(next_tensordict.get(self.in_keys[0]), tensordict.get("_step", None), stuck)
        return next_tensordict.set(self.in_keys[0], self._spoilt(now))

    def _drawn(self, purpose: str) -> Tensor:
        assert self._episode is not None
        return self._draws[purpose](self._plan, self._episode, self._rows.step)

    def _spoilt(self, answers: Tensor) -> Tensor:
        if self.flip:
            answers = answers ^ (self._drawn("flip") < self.flip)
        return answers & self._answered[self._plan]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        raise ValueError(
            "CorruptQAF counts the steps of an environment's episodes, which rows of a replay buffer do not tell: put "
            "it into the environment, behind QAFTransform, or give it to evaluate(evaluator=...)"
        )

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        assert isinstance(observation_spec, Composite)
        found = list(observation_spec.keys(True, True))
        if any(key not in found for key in self.in_keys):
            raise missing_keys(found, *map(str, self.in_keys))
        return observation_spec


class _DelayedAnswers:
    """Counts the steps of each row's episode, and keeps the answers that have not been shown yet.

    In step t of its episode, 0 at the reset, a row is shown the answers of step every · ⌊max(t - delay, 0) / every⌋.
    """

    def __init__(self, every: int, delay: int) -> None:
        self.every, self.delay = every, delay
        self._places = -(-delay // every) + 1  # as many answers are waiting to be shown, at most
        self._step: Tensor | None = None  # B int64
        self._taken: Tensor | None = None  # (B, places, S) bool; the n-th answers are in place n % places
        self._shown: Tensor | None = None  # (B, S) bool

    @property
    def step(self) -> Tensor:
        """B int64, the step of its episode that each row is at; :class:`RuntimeError` if no episode has begun."""
        if self._step is None:
            raise RuntimeError("rows have begun no episode, or not since load_state_dict: reset the environment")
        return self._step

    def begin(self, answers: Tensor, rows: Tensor | None) -> Tensor:
        """Begin the episodes of rows (B bool, None for all) with answers (B, S); return the shown answers."""
        shape = answers.shape[:-1]
        self._step = reset_rows(self._step, torch.zeros(shape, dtype=torch.int64, device=answers.device), rows)
        self._taken = reset_rows(self._taken, answers.unsqueeze(-2).repeat(*[1] * len(shape), self._places, 1), rows, 2)
        self._shown = reset_rows(self._shown, answers.clone(), rows, 1)
        return self._shown.clone()

    def advance(self, answers: Tensor, rows: Tensor | None, stuck: Callable[[], Tensor] | None) -> Tensor:
        """Return the shown answers (B, S) after a step; ``stuck`` (B, S) bool says which stay as they were shown."""
        rows = torch.ones_like(self.step, dtype=torch.bool) if rows is None else rows.reshape(self.step.shape)
        assert self._taken is not None
        assert self._shown is not None
        self._step = step = self.step + rows
        place = torch.arange(self._places, device=step.device) == (step // self.every % self._places).unsqueeze(-1)
        due = rows & (step % self.every == 0)
        self._taken = torch.where((place & due.unsqueeze(-1)).unsqueeze(-1), answers.unsqueeze(-2), self._taken)
        place = (step - self.delay).clamp(min=0) // self.every % self._places
        place = place[..., None, None].expand(*place.shape, 1, self._taken.shape[-1])
        shown = self._taken.gather(-2, place).squeeze(-2)
        if stuck is not None:
            shown = torch.where(stuck() | ~rows.unsqueeze(-1), self._shown, shown)
        self._shown = shown
        return shown.clone()


class _Draws:
    """Uniform numbers for the answers of rows, in blocks of steps, by (task, seed, episode, block)."""

    def __init__(self, purpose: str, seed: int, tables: PlanTables, plans: Plans) -> None:
        self._purpose, self._seed = purpose, seed
        self._plans = [plans[task] for task in tables.index.tasks]
        self._width = plans.num_steps
        self._which = torch.empty(0, 3, dtype=torch.int64)  # the row of the tables, episode and block of each row
        self._drawn = torch.empty(0, _BLOCK, self._width)

    def __call__(self, rows: Tensor, episode: Tensor, step: Tensor) -> Tensor:
        """Rows of the tables, their episodes and their steps, each B int64, to (B, S) float64 in [0, 1)."""
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
                purpose = f"answers/{self._purpose}/{block}"
                drawn = episode_generator(purpose, plan.definition, self._seed, number)
                steps = len(plan.steps)
                self._drawn[place, :, :steps] = torch.from_numpy(drawn.random((_BLOCK, steps)))
            self._which = which
        found = self._drawn[torch.arange(len(which)), step.reshape(-1).cpu() % _BLOCK]
        return found.reshape(*step.shape, -1).to(step.device)


def _as_texts(drop: Iterable[str | Query]) -> tuple[str, ...]:
    if isinstance(drop, (str, Query)) or not isinstance(drop, Iterable):
        raise TypeError(f"drop must be a list of queries, got {shown(drop)}")
    listed = tuple(drop)
    if wrong := [one for one in listed if not isinstance(one, (str, Query))]:
        raise TypeError(f"drop must be a list of queries, got {shown(wrong[0])} in it")
    return tuple(map(str, listed))


def _steps_with(text: str, tables: PlanTables, plans: Plans) -> Tensor:
    """(T, S) bool, the steps of the tables that have the condition."""
    found = torch.zeros_like(tables.mask)
    for row, task in enumerate(tables.index.tasks):
        query = read_query(text, plans[task].definition)
        for column, step in enumerate(plans[task].steps):
            found[row, column] = step.condition == query
    return found
