"""QAFTransform, which answers the conditions of each row's plan, and CorruptQAF, which makes answers late or wrong."""

from __future__ import annotations

from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Binary, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase, Transform
from torchrl.envs.batched_envs import BatchedEnvBase

from lw_torchrl._util.checks import Count, Natural, Probability, missing_keys, typed
from lw_torchrl._util.keys import Keys, as_keys, check_apart, key_beside, read
from lw_torchrl._util.reproducibility import episode_generator
from lw_torchrl.language.plans import AnyPlans, Plans, as_plans
from lw_torchrl.language.query_program import QueryProgram
from lw_torchrl.language.task_index import PlanTables, TaskTables, one_per_row
from lw_torchrl.transforms.environment import (
    EpisodeTransform,
    KeepsEnvState,
    base_env,
    refuse_changed,
    reset_rows,
)

_HALF = (torch.float16, torch.bfloat16)  # too coarse for positions in metres: conditions compare centimetres
_BLOCK = 64  # number of time steps whose random numbers are drawn together


class _Number(NamedTuple):
    plan: Tensor  # (T,) int64


def plan_program(plans: Plans) -> QueryProgram:
    """Return a :class:`QueryProgram` of the conditions of ``plans``, with a column for each plan step."""
    return QueryProgram({plan.definition: [step.condition for step in plan.steps] for plan in plans.values()})


def plan_number_key(qaf: NestedKey) -> NestedKey:
    """Return the key to which :class:`QAFTransform` writes the plan's number: ``qaf_plan`` for ``qaf``."""
    return key_beside(qaf, "_plan")


def latches_key(qaf: NestedKey) -> NestedKey:
    """Return the key to which :class:`QAFTransform` writes the latches: ``qaf_latches`` for ``qaf``."""
    return key_beside(qaf, "_latches")


def latches_of_rows(program: QueryProgram, observation: Tensor, task_id: Tensor, trajectory: Tensor) -> Tensor:
    """Compute the latches (R, L) bool in all rows of whole episodes.

    Args:
        program: the program of the plans' conditions.
        observation, task_id: (R, D) float and (R,) int64, the rows of consecutive episodes in the order of time.
        trajectory: (R,) int64, a number that changes where an episode begins.
    """
    latches = torch.zeros(len(task_id), program.num_latches, dtype=torch.bool, device=observation.device)
    is_first = torch.ones(len(task_id), dtype=torch.bool, device=observation.device)
    is_first[1:] = trajectory[1:] != trajectory[:-1]
    start = is_first.nonzero().flatten()
    length = torch.diff(start, append=start.new_tensor([len(task_id)]))
    for step in range(int(length.max()) if len(length) else 0):
        rows = start[length > step] + step
        before = latches[rows - 1] if step else torch.zeros_like(latches[rows])
        latches[rows] = program.remember(observation[rows], task_id[rows], before)[1]
    return latches


def truth_of_episode(plans: Plans, steps: TensorDictBase) -> Tensor:
    """Return the truth (T, S) bool of the plans' conditions in the steps (T,) of one episode, with its latches."""
    program, observation, task_id = plan_program(plans), steps.get("observation"), steps.get("task_id")
    if not program.num_latches:
        return program(observation, task_id)
    return program(observation, task_id, latches_of_rows(program, observation, task_id, torch.zeros_like(task_id)))


class QAFTransform(KeepsEnvState):
    """A transform that answers the conditions of each row's plan, in an environment or on a replay buffer.

    Reads ``observation`` (B, 39) float32 and ``task_id`` (B,) int64; writes ``qaf`` (B, S) bool, the truth value of
    each plan step's condition (false beyond the last step), and ``qaf_plan`` (B,) int64, the plan's number in
    :attr:`Plans.numbers`, by which an actor with other plans rejects the answers. On a replay buffer, it also
    writes ``("next", "qaf")`` if ``("next", "observation")`` exists. In an environment, the ``state_dict`` includes
    that of the environment, as for :class:`EnvState`.

    If a condition has latches ("the puck has been near the goal", "once (...)"), it also writes ``qaf_latches``
    (B, L) bool: the latches that are true since an earlier or this step of the episode. In an environment, every reset
    of a row clears its latches. Rows of a replay buffer must have this key: rollouts have it, and
    :class:`LanguageWorldExperienceReplay` computes it.

    Conditions compare metres, so put this transform before transforms that change the observation, such as
    ``ObservationNorm`` or :class:`RandomYaw`. A wrong order raises an error, except in the workers of a SerialEnv or
    ParallelEnv.

    Args:
        plans: a plan for each task that will be seen.
        in_keys: replacements for the keys ``observation`` and ``task_id``, in this order.
        out_keys: a replacement for the key ``qaf``; the suffixes ``_plan`` and ``_latches`` give the other keys.

    Raises:
        PlanError: (a ValueError) the environment has a task without a plan.
        ValueError: a task has no plan, the observation is malformed or has half precision, an earlier transform
            changes the observation, or rows of a replay buffer lack latches.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> import lw_torchrl as lw
        >>> env = TransformedEnv(lw.LanguageWorldEnv("reach"), lw.QAFTransform(lw.load_plans("MT10")))
        >>> env.reset()["qaf"].dtype
        torch.bool

    Source: paper section 'Query Answering Function'.
    """

    @typed
    def __init__(self, plans: AnyPlans, *, in_keys: Keys | None = None, out_keys: Keys | None = None) -> None:
        truth = as_keys("out_keys", out_keys, ("qaf",))
        keys = as_keys("in_keys", in_keys, ("observation", "task_id"))
        plans = as_plans(plans)
        program = plan_program(plans)
        latches = [latches_key(truth[0])] if program.num_latches else []
        super().__init__(in_keys=keys, out_keys=[*truth, plan_number_key(truth[0]), *latches])
        check_apart(self.in_keys, self.out_keys)
        self.plans, self.program = plans, program
        tables = PlanTables(self.plans)
        self._number = TaskTables(tables.index, _Number(tables.number), f"tasks without a plan in {self.plans!r}")
        self._task: Tensor | None = None  # the task of each row since its last reset

    def with_plans(self, plans: AnyPlans) -> QAFTransform:
        """Return a transform that answers the conditions of different plans."""
        return QAFTransform(plans, in_keys=self.in_keys, out_keys=self.out_keys[:1])

    def _write(self, tensordict: TensorDictBase, task_id: Tensor | None, before: Tensor | None = None) -> None:
        """Write the answers, and the latches that follow from those ``before``."""
        observation = tensordict.get(self.in_keys[0], None)
        if observation is None or task_id is None:
            raise missing_keys(tensordict.keys(True, True), *map(str, self.in_keys))
        if observation.dtype in _HALF:
            got = f"got {observation.dtype}; put QAFTransform before the transform that casts the observation"
            raise ValueError(f"observation must be float32 or float64, {got}")
        task_id = one_per_row(task_id, observation)
        if self.program.num_latches:
            truth, latches = self.program.remember(observation, task_id, before)
            tensordict.set(self.out_keys[2], latches)
        else:
            truth = self.program(observation, task_id)
        tensordict.set(self.out_keys[0], truth)
        number = self._number.select(task_id.reshape(-1), observation).plan
        tensordict.set(self.out_keys[1], number.reshape(task_id.shape).clone())  # a collector zeroes it in place

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        before = None
        if self.program.num_latches:
            before = tensordict.get(self.out_keys[2], None)
            if before is None:
                raise ValueError(f"a step requires {self.out_keys[2]!r}, the latches before it, which a reset writes")
        self._write(next_tensordict, next_tensordict.get(self.in_keys[1], None), before)
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        begun, task = tensordict.get("_reset", None), tensordict_reset.get(self.in_keys[1], None)
        self._task = task if task is None else reset_rows(self._task, task, begun)
        self._write(tensordict_reset, self._task, self._cleared(tensordict, tensordict_reset, begun))
        return tensordict_reset

    def _cleared(self, tensordict: TensorDictBase, fresh: TensorDictBase, begun: Tensor | None) -> Tensor | None:
        """Return the latches of all rows, false in the rows that are reset.

        If TorchRL passes no latches, it restores those of the other rows itself.
        """
        observation = fresh.get(self.in_keys[0], None)
        if not self.program.num_latches or observation is None:
            return None
        shape = (*observation.shape[:-1], self.program.num_latches)
        none = torch.zeros(shape, dtype=torch.bool, device=observation.device)
        return reset_rows(tensordict.get(self.out_keys[2], None), none, begun, 1)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        observation, task = self.in_keys
        task_id, before = tensordict.get(task, None), None
        if self.program.num_latches:
            before = tensordict.get(self.out_keys[2], None)
            if before is None:
                raise ValueError(
                    f"the plans' conditions depend on earlier steps ('has been', 'once (...)'), but the rows have no "
                    f"{self.out_keys[2]!r}: use a rollout with this QAFTransform or LanguageWorldExperienceReplay("
                    "transform=QAFTransform(plans)), which compute it per episode"
                )
        self._write(tensordict, task_id, before)
        following = tensordict.get("next", None)
        if following is not None and following.get(observation, None) is not None:
            if self.program.num_latches:
                before = following.get(self.out_keys[2], tensordict.get(self.out_keys[2]))
            self._write(following, following.get(task, task_id), before)
        return tensordict

    def set_container(self, container: Transform | EnvBase) -> None:
        super().set_container(container)
        refuse_changed(self, self.in_keys[0])
        env = base_env(self)
        if not isinstance(env, BatchedEnvBase):  # its workers may not be running yet
            self.plans.require(getattr(env, "tasks", ()))

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        assert isinstance(observation_spec, Composite)
        refuse_changed(self, self.in_keys[0])  # a transform may have been inserted before this one
        steps, shape, device = self.program.num_queries, observation_spec.shape, observation_spec.device
        observation_spec[self.out_keys[0]] = Binary(steps, shape=(*shape, steps), dtype=torch.bool, device=device)
        observation_spec[self.out_keys[1]] = Unbounded(shape, dtype=torch.int64, device=device)
        if self.program.num_latches:
            observation_spec[self.out_keys[2]] = self._latches_spec(shape, device)
        return observation_spec

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        if self.program.num_latches:  # so that batched environments send the latches to their workers
            if input_spec["full_state_spec"] is None:
                input_spec["full_state_spec"] = Composite(shape=input_spec.shape, device=input_spec.device)
            spec = self._latches_spec(input_spec.shape, input_spec.device)
            input_spec["full_state_spec"][self.out_keys[2]] = spec
        return input_spec

    def _latches_spec(self, shape: torch.Size, device: torch.device | None) -> Binary:
        count = self.program.num_latches
        return Binary(count, shape=(*shape, count), dtype=torch.bool, device=device)


class CorruptQAF(EpisodeTransform):
    """A transform that makes the answers in ``qaf`` outdated or wrong, to simulate slow or unreliable condition checks.

    For environments, after a :class:`QAFTransform`. Reads ``qaf`` (B, S) bool, or float in [0, 1], ``task_id`` (B,) and
    ``episode`` (B,) int64, and ``qaf_plan`` (B,) int64 if present; changes only ``qaf``:

    - **every, delay** (outdated): at time step t of the episode (0 at the reset), a row has the answers of time step
      every · ⌊max(t - delay, 0) / every⌋;
    - **flip** (wrong): at each time step, including the reset, each answer is then inverted with this probability.

    The random numbers depend only on (task, seed, episode, time step) and the plan step; a larger
    probability inverts all answers that a smaller probability inverts. :func:`lw_torchrl.evaluate` accepts this
    transform as ``evaluator``. To corrupt a learned evaluator's answers, put a transform that calls the evaluator in
    ``_reset`` and ``_call`` before this transform.

    Args:
        plans: the plans whose conditions ``qaf`` answers.
        every: update a row's answers every N time steps.
        delay: number of time steps until new answers appear.
        flip: probability of inverting an answer.
        seed: random seed, any integer.
        in_keys: replacements for the keys ``qaf``, ``task_id`` and ``episode``, in this order.

    Raises:
        ValueError: ``qaf`` is missing, has a wrong shape, dtype or plan, or the transform is used in a replay buffer.
        RuntimeError: the environment takes a step without a reset, or without a reset since ``load_state_dict``.

    Example:
        >>> import lw_torchrl as lw
        >>> plans = lw.load_plans("MT10")
        >>> actor, noisy = lw.ScriptedSkillActor(plans), lw.transforms.CorruptQAF(plans, every=2, flip=0.05)
        >>> lw.evaluate(actor, tasks="reach", episodes_per_task=2, seed=1_000, evaluator=noisy).success_once
        {'reach': 1.0}

    Source: the paper suggests a visual question answering model as query answering function, which makes errors.
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
        in_keys: Keys | None = None,
    ) -> None:
        keys = as_keys("in_keys", in_keys, ("qaf", "task_id", "episode"))
        super().__init__(in_keys=keys, out_keys=keys[:1])
        self.plans = as_plans(plans)
        self.every, self.delay, self.flip, self.seed = every, delay, flip, seed
        self._tables = PlanTables(self.plans)
        self._task: Tensor | None = None  # B int64, the tasks of the rows' episodes
        self._episode: Tensor | None = None
        self._plan = torch.empty(0, dtype=torch.int64)  # B int64, row indices of the tables
        self._forget_episodes()

    def _forget_episodes(self) -> None:
        self._places = -(-self.delay // self.every) + 1  # maximum number of stored answers
        self._steps: Tensor | None = None  # B int64, time steps since each row's reset
        self._answers: Tensor | None = None  # (B, places, S); the n-th update is at place n % places
        self._draws = _Draws(self.seed, self._tables, self.plans)

    def with_plans(self, plans: AnyPlans) -> CorruptQAF:
        """Return a transform that corrupts the answers of different plans in the same way."""
        options = {name: getattr(self, name) for name in ("every", "delay", "flip", "seed", "in_keys")}
        return CorruptQAF(plans, **options)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        truth, task, episode = read(tensordict_reset, self.in_keys)
        begun = tensordict.get("_reset", None)
        self._task, self._episode = reset_rows(self._task, task, begun), reset_rows(self._episode, episode, begun)
        self._plan = self._tables.rows(self._task)
        self._tables.refuse_others(tensordict_reset.get(plan_number_key(self.in_keys[0]), None), self._plan)
        shape = (*self._plan.shape, self.plans.num_steps)
        if truth.shape != shape or not (truth.dtype == torch.bool or truth.is_floating_point()):
            got = f"{truth.dtype} of shape {tuple(truth.shape)}"
            raise ValueError(f"qaf must be bool (or float, for soft truth values) of shape {shape}, got {got}")
        self._steps = reset_rows(self._steps, torch.zeros_like(self._plan), begun)
        self._answers = reset_rows(self._answers, torch.stack([truth] * self._places, -2), begun, 2)
        return self._show(tensordict_reset)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        if self._steps is None or self._answers is None:
            raise RuntimeError("no episode has begun since the start or load_state_dict: reset the environment")
        moved = tensordict.get("_step", None)
        moved = torch.ones_like(self._steps, dtype=torch.bool) if moved is None else moved.reshape(self._steps.shape)
        self._steps = self._steps + moved
        due = moved & (self._steps % self.every == 0)
        place = torch.arange(self._places, device=due.device) == self._place(self._steps).unsqueeze(-1)
        truth = next_tensordict.get(self.in_keys[0]).unsqueeze(-2)
        self._answers = torch.where((place & due.unsqueeze(-1)).unsqueeze(-1), truth, self._answers)
        return self._show(next_tensordict)

    def _place(self, step: Tensor) -> Tensor:
        return step // self.every % self._places

    def _show(self, tensordict: TensorDictBase) -> TensorDictBase:
        assert self._steps is not None
        assert self._answers is not None
        assert self._episode is not None
        place = self._place((self._steps - self.delay).clamp(min=0))[..., None, None]
        answers = self._answers.gather(-2, place.expand(*place.shape[:-1], self._answers.shape[-1])).squeeze(-2)
        if self.flip:
            wrong = self._draws(self._plan, self._episode, self._steps) < self.flip
            answers = answers ^ wrong if answers.dtype == torch.bool else torch.where(wrong, 1 - answers, answers)
        return tensordict.set(self.in_keys[0], answers)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        raise ValueError(
            "CorruptQAF counts the steps of an environment's episodes, which rows of a replay buffer do not record: "
            "put it into the environment, after QAFTransform, or pass it to evaluate(evaluator=...)"
        )

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        assert isinstance(observation_spec, Composite)
        keys = list(observation_spec.keys(True, True))
        if any(key not in keys for key in self.in_keys):
            raise missing_keys(keys, *map(str, self.in_keys))
        return observation_spec


class _Draws:
    """Uniform random numbers for answers, in blocks of time steps, by (task, seed, episode, block); padding is 1."""

    def __init__(self, seed: int, tables: PlanTables, plans: Plans) -> None:
        self._seed = seed
        self._plans = [plans[task] for task in tables.index.tasks]
        self._width = plans.num_steps
        self._which = torch.empty(0, 3, dtype=torch.int64)  # the table row, episode and block of each row
        self._numbers = torch.empty(0, _BLOCK, self._width, dtype=torch.float32)

    def __call__(self, rows: Tensor, episode: Tensor, step: Tensor) -> Tensor:
        """Return numbers (B, S) float64 in [0, 1] for table rows, episodes and time steps (each B int64)."""
        which = torch.stack([each.reshape(-1).cpu() for each in (rows, episode, step // _BLOCK)], -1)
        if which.shape != self._which.shape:
            self._which = torch.full_like(which, -1)
            self._numbers = torch.ones(len(which), _BLOCK, self._width, dtype=torch.float64)
        if not torch.equal(which, self._which):
            for place in (which != self._which).any(-1).nonzero().flatten().tolist():
                row, number, block = which[place].tolist()
                if number < 0:  # never reset
                    continue
                plan = self._plans[row]
                generator = episode_generator(f"answers/flip/{block}", plan.definition, self._seed, number)
                steps = len(plan.steps)
                self._numbers[place, :, :steps] = torch.from_numpy(generator.random((_BLOCK, steps)))
            self._which = which
        numbers = self._numbers[torch.arange(len(which)), step.reshape(-1).cpu() % _BLOCK]
        return numbers.reshape(*step.shape, -1).to(step.device)
