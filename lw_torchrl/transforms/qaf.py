"""QAFTransform, which checks the conditions of each row's plan, and CorruptQAF, which delays or flips the answers."""

from __future__ import annotations

from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase, Transform
from torchrl.envs.batched_envs import BatchedEnvBase

from lw_torchrl._util.checks import Count, Natural, Probability, typed
from lw_torchrl._util.devices import check_values
from lw_torchrl._util.keys import Keys, as_keys, check_apart, key_beside, read
from lw_torchrl._util.reproducibility import episode_hash
from lw_torchrl.language.plans import AnyPlans, Plans, as_plans
from lw_torchrl.language.query_program import QueryProgram
from lw_torchrl.language.task_index import PlanTables, TaskTables, answers_of, one_per_row
from lw_torchrl.transforms.environment import (
    EpisodeTransform,
    KeepsEnvState,
    base_env,
    begun,
    refuse_changed,
    reset_rows,
)

_HALF = (torch.float16, torch.bfloat16)  # too coarse for positions in metres: conditions compare centimetres


class _Number(NamedTuple):
    plan: Tensor  # (T,) int64


def read_truth(tensordict: TensorDictBase, keys: Keys, tables: PlanTables) -> tuple[Tensor, Tensor]:
    """Return truth values (..., S), and each task's row (...) int64 in ``tables``, from the keys of ``qaf`` and
    ``task_id``; raise a ValueError if the truth is of other plans, has a wrong shape, or is outside [0, 1]."""
    qaf, task_id = read(tensordict, keys)
    qaf, rows = answers_of(qaf, task_id, tensordict.get(key_beside(keys[0], "_plan"), None), tables)
    if qaf.shape != (shape := (*rows.shape, tables.mask.shape[-1])):
        raise ValueError(f"qaf must have shape {shape}, got {tuple(qaf.shape)}; give QAFTransform this module's plans")
    if qaf.dtype != torch.bool:
        problem = "qaf must be bool, or numbers from 0 to 1 (soft truth), but holds NaN or other numbers"
        check_values(lambda truth: ((truth >= 0) & (truth <= 1)).all(), qaf, problem)
    return qaf, rows


def plan_program(plans: Plans) -> QueryProgram:
    """Return a :class:`QueryProgram` of the conditions of ``plans``, with a column for each plan step."""
    return QueryProgram({plan.definition: [step.condition for step in plan.steps] for plan in plans.values()})


def latches_of_rows(program: QueryProgram, observation: Tensor, task_id: Tensor, trajectory: Tensor) -> Tensor:
    """Compute the latches (R, L) bool of all rows of complete episodes.

    Args:
        program: the program of the plans' conditions.
        observation, task_id: (R, D) float and (R,) int64, the rows of consecutive episodes in the order of time.
        trajectory: (R,) int64, a number that changes wherever a new episode begins.
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
    """Evaluate the plans' conditions, which may refer to earlier steps, in an episode (T,); return (T, S) bool."""
    program, observation, task_id = plan_program(plans), steps.get("observation"), steps.get("task_id")
    if not program.num_latches:
        return program(observation, task_id)
    return program(observation, task_id, latches_of_rows(program, observation, task_id, torch.zeros_like(task_id)))


class QAFTransform(KeepsEnvState):
    """A transform that answers the conditions of each row's plan, in an environment or on a replay buffer.

    Reads ``observation`` (B, 39) float32 and ``task_id`` (B,) int64; writes ``qaf`` (B, S) bool, the truth value of
    each plan step's condition (false beyond the last step), and ``qaf_plan`` (B,) int64, the plan's number in
    :attr:`Plans.numbers`, with which an actor detects answers to other plans. On a replay buffer, the transform also
    writes ``("next", "qaf")`` if ``("next", "observation")`` exists. In an environment, the ``state_dict`` includes
    that of the environment, so that a resumed Collector continues with the next episodes.

    If conditions depend on earlier steps ("the puck has been near the goal", "once (...)"), the transform also writes
    ``qaf_latches`` (B, L) bool. A latch becomes true when its condition first holds, and stays true until the episode
    ends. Rows of a replay buffer must have this key: rollouts have it, and :class:`LanguageWorldExperienceReplay`
    computes it.

    Conditions compare distances in metres, so put this transform before transforms that change the observation, such as
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

    def __init__(self, plans: AnyPlans, *, in_keys: Keys | None = None, out_keys: Keys | None = None) -> None:
        truth = as_keys("out_keys", out_keys, ("qaf",))
        keys = as_keys("in_keys", in_keys, ("observation", "task_id"))
        plans = as_plans(plans)
        program = plan_program(plans)
        beside = ("_plan", "_latches") if program.num_latches else ("_plan",)
        super().__init__(in_keys=keys, out_keys=[*truth, *(key_beside(truth[0], ending) for ending in beside)])
        check_apart(self.in_keys, self.out_keys)
        self.plans, self.program = plans, program
        tables = PlanTables(self.plans)
        self._number = TaskTables(tables.index, _Number(tables.number), f"tasks without a plan in {self.plans!r}")
        self._task: Tensor | None = None  # the task of each row since its last reset

    def with_plans(self, plans: AnyPlans) -> QAFTransform:
        """Return a transform that answers the conditions of another set of plans."""
        return QAFTransform(plans, in_keys=self.in_keys, out_keys=self.out_keys[:1])

    def _write(self, tensordict: TensorDictBase, task_id: Tensor, before: Tensor | None = None) -> None:
        """Write the answers, and the latches after this step, given the latches ``before`` this step."""
        (observation,) = read(tensordict, self.in_keys[:1])
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
        tensordict.set(self.out_keys[1], number.reshape(task_id.shape).clone())  # collectors zero the tensor in place

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        before = read(tensordict, self.out_keys[2:])[0] if self.program.num_latches else None  # a reset writes them
        (task_id,) = read(next_tensordict, self.in_keys[1:])
        self._write(next_tensordict, task_id, before)
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        which, (observation, task), latches = tensordict.get("_reset", None), read(tensordict_reset, self.in_keys), None
        self._task = reset_rows(self._task, task, which)
        if count := self.program.num_latches:
            # If ``tensordict`` lacks the latches, all become false, and TorchRL restores those of the other rows.
            false = torch.zeros(*observation.shape[:-1], count, dtype=torch.bool, device=observation.device)
            latches = reset_rows(tensordict.get(self.out_keys[2], None), false, which, 1)
        self._write(tensordict_reset, self._task, latches)
        return tensordict_reset

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        observation, task = self.in_keys
        (_, task_id), before = read(tensordict, self.in_keys), None
        if self.program.num_latches and (before := tensordict.get(self.out_keys[2], None)) is None:
            raise ValueError(f"rows lack {self.out_keys[2]!r}: use LanguageWorldExperienceReplay with this transform")
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

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
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

    Use it in an environment, after a :class:`QAFTransform`. Reads ``qaf`` (B, S) bool, or float in [0, 1], ``task_id``
    and ``episode`` (B,) int64, and ``qaf_plan`` (B,) int64 if present; changes only ``qaf``:

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

    Source: the paper suggests a visual question answering model to check conditions; such a model makes errors.
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
        self._plan = self._key = torch.empty(0, dtype=torch.int64)  # B int64, row indices of the tables; random keys
        self._real = torch.empty(0, dtype=torch.bool)  # (B, S), false beyond the end of a plan
        self._forget_episodes()

    def _forget_episodes(self) -> None:
        self._places = -(-self.delay // self.every) + 1  # maximum number of stored answers
        self._steps: Tensor | None = None  # B int64, time steps since each row's reset
        self._answers: Tensor | None = None  # (B, places, S); the n-th update is at place n % places

    def with_plans(self, plans: AnyPlans) -> CorruptQAF:
        """Return a transform that corrupts the answers of another set of plans in the same way."""
        options = {name: getattr(self, name) for name in ("every", "delay", "flip", "seed", "in_keys")}
        return CorruptQAF(plans, **options)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        truth, task, episode = read(tensordict_reset, self.in_keys)
        which = tensordict.get("_reset", None)
        self._task, self._episode = reset_rows(self._task, task, which), reset_rows(self._episode, episode, which)
        self._plan = self._tables.rows(self._task)
        self._tables.refuse_others(tensordict_reset.get(key_beside(self.in_keys[0], "_plan"), None), self._plan)
        shape = (*self._plan.shape, self.plans.num_steps)
        if truth.shape != shape or not (truth.dtype == torch.bool or truth.is_floating_point()):
            got = f"{truth.dtype} of shape {tuple(truth.shape)}"
            raise ValueError(f"qaf must be bool (or float, for soft truth values) of shape {shape}, got {got}")
        if self.flip:
            plans = [self.plans[self._tables.index.tasks[row]] for row in self._plan.flatten().cpu().tolist()]
            numbers = self._episode.flatten().clamp(min=0).cpu().tolist()  # -1: a row that was never reset
            pairs = zip(plans, numbers, strict=True)
            keys = [episode_hash("answers/flip", plan.definition, self.seed, number) for plan, number in pairs]
            self._key = torch.tensor(keys, device=self._plan.device).reshape(self._plan.shape)
            self._real = self._tables.mask.to(self._plan.device)[self._plan]
        self._steps = reset_rows(self._steps, torch.zeros_like(self._plan), which)
        self._answers = reset_rows(self._answers, torch.stack([truth] * self._places, -2), which, 2)
        return self._show(tensordict_reset)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        steps, moved = begun(self._steps), tensordict.get("_step", None)
        moved = torch.ones_like(steps, dtype=torch.bool) if moved is None else moved.reshape(steps.shape)
        self._steps = steps + moved
        due = moved & (self._steps % self.every == 0)
        place = torch.arange(self._places, device=due.device) == self._place(self._steps).unsqueeze(-1)
        truth = next_tensordict.get(self.in_keys[0]).unsqueeze(-2)
        self._answers = torch.where((place & due.unsqueeze(-1)).unsqueeze(-1), truth, begun(self._answers))
        return self._show(next_tensordict)

    def _place(self, step: Tensor) -> Tensor:
        return step // self.every % self._places

    def _show(self, tensordict: TensorDictBase) -> TensorDictBase:
        steps, answers = begun(self._steps), begun(self._answers)
        place = self._place((steps - self.delay).clamp(min=0))[..., None, None]
        answers = answers.gather(-2, place.expand(*place.shape[:-1], answers.shape[-1])).squeeze(-2)
        if self.flip:
            wrong = self._real & (_uniform(self._key, steps, self._real.shape[-1]) < self.flip)
            answers = answers ^ wrong if answers.dtype == torch.bool else torch.where(wrong, 1 - answers, answers)
        return tensordict.set(self.in_keys[0], answers)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        raise ValueError("CorruptQAF does not work on replay buffers; put it into the environment, after QAFTransform")


def _uniform(key: Tensor, step: Tensor, width: int) -> Tensor:
    """Return numbers (B, width) float64 in [0, 1), hashes of a key (B,) int64, a time step (B,) int64 and the column.

    Source: Steele, Lea, Flood, "Fast splittable pseudorandom number generators" (SplitMix64).
    """
    counter = step.unsqueeze(-1) * 2**32 + torch.arange(1, width + 1, device=step.device)
    bits = key.unsqueeze(-1) + counter * -0x61C8864680B583EB  # products of int64 wrap around
    for shift, factor in ((30, -0x40A7B892E31B1A47), (27, -0x6B2FB644ECCEEE15), (31, 1)):
        bits = (bits ^ (bits >> shift & 2 ** (64 - shift) - 1)) * factor
    return (bits >> 11 & 2**53 - 1).to(torch.float64) * 2**-53
