"""log_rollout: a rollout as a page of a recording, with the robot as it moved, which is simulated again for it."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor

from lw_torchrl._checks import checked, missing_keys, shown
from lw_torchrl.envs.engines.vectorized.engine import VectorizedEngine
from lw_torchrl.envs.seeding import episode_seed
from lw_torchrl.evaluation.failures import Failure
from lw_torchrl.language.named_objects import GRIPPER
from lw_torchrl.language.plans import ConditionalPlan, Plans, as_plans
from lw_torchrl.language.tasks import MT50, TASKS, Task, task_id
from lw_torchrl.record.mujoco_scene import Motion
from lw_torchrl.record.recorded_episode import RecordedEpisode
from lw_torchrl.record.rerun_logger import RerunLogger
from lw_torchrl.record.verdict import Heading


@checked
def log_rollout(
    logger: RerunLogger,
    rollout: TensorDictBase,
    plans: Plans | Mapping[str, ConditionalPlan] | None = None,
    *,
    seed: int | None = None,
    name: str | None = None,
    policy: str | None = None,
    failure: Failure | Sequence[Failure | None] | None = None,
    tasks: Iterable[Task] = (),
) -> Any:
    """Add a rollout to a recording: the robot in 3-D, a verdict, the plan at the cursor, the timeline and curves.

    Where the environment's seed is given, the episode is simulated again, from its task, ``seed``, ``episode`` and
    actions, and the robot is shown as it moved. The observations must come out the same, bit for bit; where they do
    not, a warning says so, and a hand over a table stands for the robot, as it does without a seed.

    Args:
        logger: the recording.
        rollout: batch size (T,), one episode from its first state on: "observation" T×39 float32 (metres), "task_id" T
            int64, "action" T×4 float32 in [-1, 1], as executed, and ("next", "success") T×1 bool. Optional are
            ("next", "executed_action") T×4, which is taken in the place of the action, "episode" T int64, "qaf" T×S
            bool, "qaf_plan" T int64, "qaf_logits" T×S float32 (positive: true), "skill_weights" T×S float32,
            "action_corrected" T×1 and ("next", "reward") T×1 float32. Or batch size (N, T), an episode in each row.
        plans: what ``qaf`` answers; None for no plan.
        seed: of the environment; with ``episode`` it says how the episode began.
        name: of the episode in the recording; None takes "push-7", of task and episode, or else "push".
        policy: who acted, in a word, for the tab.
        failure: why it failed, for the verdict; of N rows one for each, None where there is none.
        tasks: of your own, where the plans do not say what they are.

    Returns:
        The name; of N rows a list of names.

    Raises:
        ValueError: the rows are of several episodes; ``qaf`` answers other plans; the failure is another episode's.
        PlanError: (a ValueError) there is no plan for the task.

    Example:
        >>> import tempfile
        >>> import lw_torchrl as lw
        >>> env = lw.LanguageWorldEnv("reach", seed=7)
        >>> rollout = env.rollout(20, lw.ExpertActor("reach"))[0]
        >>> with lw.RerunLogger(tempfile.mkdtemp() + "/reach.rrd") as logger:
        ...     lw.log_rollout(logger, rollout, seed=7, policy="expert")
        'reach-0'
        >>> env.close()
    """
    if len(rollout.batch_size) == 2:
        if name is not None:
            raise ValueError(f"name is of one episode, but rollout holds {len(rollout)}; got {name!r}")
        failures = failure if isinstance(failure, Sequence) else [failure] * len(rollout)
        if len(failures) != len(rollout):
            raise ValueError(f"failure must be one for each of {len(rollout)} rows, got {len(failures)}")
        rows, tasks = zip(rollout, failures, strict=True), list(tasks)
        return [
            log_rollout(logger, row, plans, seed=seed, policy=policy, failure=why, tasks=tasks) for row, why in rows
        ]
    if isinstance(failure, Sequence):
        raise ValueError(f"failure must be one Failure for one episode, got {len(failure)}")
    heading, episode = read_rollout(rollout, plans, seed=seed, policy=policy, failure=failure, tasks=tasks)
    motion = _motion(heading, episode) if seed is not None and heading.task in TASKS else None
    return logger.add_page(heading, episode, motion=motion, name=name)


def read_rollout(
    rollout: TensorDictBase,
    plans: Plans | Mapping[str, ConditionalPlan] | None = None,
    *,
    seed: int | None = None,
    policy: str | None = None,
    failure: Failure | None = None,
    tasks: Iterable[Task] = (),
) -> tuple[Heading, RecordedEpisode]:
    """What a page shows of a rollout (T,), checked, as :func:`log_rollout` has it."""
    plans = None if plans is None else as_plans(plans)
    number = _single(rollout, "task_id", required=True)
    index = _single(rollout, "episode", required=seed is not None)
    assert number is not None
    task = _definition(number, [*tasks, *(plan.definition for plan in (plans or {}).values())])
    label = f"task-{number}" if task is None else task.name
    plan = None
    if plans is not None:
        plans.require([label])
        plan = plans[label]
        _check_answers(rollout, plan)
    if not isinstance(failure, Failure | None):
        raise TypeError(f"failure must be a Failure, got {shown(failure)} ({type(failure).__name__})")
    if failure is not None and (failure.task, failure.episode) != (label, failure.episode if index is None else index):
        raise ValueError(
            f"failure must be of the rollout's episode, {label} {index}, got that of {failure.task} {failure.episode}"
        )
    observation = rollout.get("observation", None)
    objects: dict[str, Tensor] = {}
    if task is not None and observation is not None and observation.shape[1:] == (39,):
        positions = task.positions(observation).items()
        objects = {named: position for named, position in positions if _is_told_of(named, plan)}
    episode = RecordedEpisode.from_rollout(rollout, objects, plan)
    if task is not None and plan is not None:
        episode = episode.with_target_poses(task)
    return Heading(label, index, seed, policy, failure), episode


class Difference(NamedTuple):
    """Where a rollout and its simulation first differ: in which step, from 0, in which entry most, and by how much."""

    step: int
    entry: int
    by: float


def simulate_again(
    task: str, seed: int, episode: int, action: NDArray[np.float32], observation: NDArray[np.float32]
) -> Motion | Difference:
    """The motion of all bodies in an episode, of T + 1 rows, or where it turns out to be another episode.

    The simulation depends on the seed and the actions alone, so equal observations, bit for bit, mean equal motion.
    Actions are T×4 float32 in [-1, 1], as executed; observations T×39 float32, those from which they were taken.

    Example:
        >>> found = simulate_again("reach", 0, 0, np.zeros((1, 4), np.float32), np.zeros((1, 39), np.float32))
        >>> found.step
        0
    """
    engine = VectorizedEngine([task], num_threads=1)
    try:
        first = engine.reset([0], [episode_seed(task, seed, episode)])[0]
        poses = engine.poses(0)
        length = len(action)
        positions = np.empty((length + 1, *poses.position.shape), np.float32)
        quaternions = np.empty((length + 1, *poses.quaternion.shape), np.float32)
        seen = first.astype(np.float32)
        active = np.ones(1, bool)
        for step in range(length):
            if not np.array_equal(seen, observation[step]):
                off = np.abs(seen.astype(np.float64) - observation[step])
                return Difference(step, int(off.argmax()), float(off.max()))
            positions[step], quaternions[step] = poses
            seen = engine.step(action[step : step + 1], active).observation[0].astype(np.float32)
            poses = engine.poses(0)
        positions[length], quaternions[length] = poses
        return Motion(engine.model(0), positions, quaternions)
    finally:
        engine.close()


def _motion(heading: Heading, episode: RecordedEpisode) -> Motion | None:
    assert heading.seed is not None
    assert heading.episode is not None
    found = simulate_again(heading.task, heading.seed, heading.episode, episode.action, episode.observation)
    if not isinstance(found, Difference):
        return found
    warnings.warn(
        f"simulating {heading.task}, episode {heading.episode} of seed {heading.seed}, again gives other numbers at "
        f"step {found.step}: number {found.entry} is {found.by:.3g} off. Was it the seed, and are these the executed "
        "actions? A hand over a table is drawn in the place of the robot",
        stacklevel=3,
    )
    return None


def _single(rollout: TensorDictBase, key: str, *, required: bool) -> int | None:
    """The one number that a column of integers holds."""
    column = rollout.get(key, None)
    if column is None:
        if required:
            raise missing_keys(rollout.keys(True, True), key)
        return None
    length = tuple(rollout.batch_size)
    if column.is_floating_point() or tuple(column.shape) not in (length, (*length, 1)):
        given = f"{column.dtype} {tuple(column.shape)}"
        raise ValueError(f"rollout[{key!r}] must be integers of shape {length}, got {given}")
    found = torch.unique(column).tolist()
    if len(found) != 1:
        raise ValueError(f"rollout must be one episode of one task, got {key!r} {found[:5]}; split it")
    return int(found[0])


def _definition(number: int, tasks: Sequence[Task]) -> Task | None:
    """The task of an id: one of these, or of the 50."""
    found = next((task for task in tasks if task_id(task.name) == number), None)
    return TASKS[MT50[number]] if found is None and 0 <= number < len(MT50) else found


def _check_answers(rollout: TensorDictBase, plan: ConditionalPlan) -> None:
    answered = rollout.get("qaf_plan", None)
    if answered is None:
        return
    expected = Plans([plan]).numbers[plan.task]
    if not bool((answered == expected).all()):
        raise ValueError(f"rollout['qaf'] answers another plan of {plan.task!r} than was given, as 'qaf_plan' tells")


def _is_told_of(name: str, plan: ConditionalPlan | None) -> bool:
    """Whether a plan speaks of an object; without a plan all are of interest."""
    return plan is None or name == GRIPPER or any(name in f"{step.condition} {step.skill}" for step in plan.steps)
