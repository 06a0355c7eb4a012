"""Log rollouts as pages of a recording, re-simulate episodes to show the robot's motion, and run episodes to record."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from lw_torchrl._util.checks import missing_keys, typed
from lw_torchrl._util.devices import device_of
from lw_torchrl._util.files import AnyPath, replacing
from lw_torchrl.envs.episodes import FinishedEpisode
from lw_torchrl.envs.rows import episode_seed
from lw_torchrl.evaluation.diagnose.failure import Failure, replacement_text
from lw_torchrl.evaluation.rollout import actor_plans, suite_tasks
from lw_torchrl.evaluation.rollout import rollout as run_rollout
from lw_torchrl.language.layout import METAWORLD
from lw_torchrl.language.objects import GRIPPER
from lw_torchrl.language.plans import AnyPlans, Plans, as_plans
from lw_torchrl.language.tasks import MT50, TASKS, Task, task_id
from lw_torchrl.modules.query_evaluator import QueryEvaluator, evaluators_of
from lw_torchrl.record.entities import STEP_TIME
from lw_torchrl.record.meshes import Motion
from lw_torchrl.record.recorded_episode import Ghost, RecordedEpisode
from lw_torchrl.record.rerun_logger import RerunLogger, is_complete
from lw_torchrl.record.verdict import Heading
from lw_torchrl.suites.suite import Suite, known_suite, load_suite
from lw_torchrl.transforms.qaf import QAFTransform, latches_of_rows

_KEYS: list[NestedKey] = ["observation", "task_id", "episode", "action", ("next", "success"), ("next", "reward")]
_PLAN_KEYS = ("qaf", "qaf_logits", "skill_weights")


@typed
def log_rollout(
    logger: RerunLogger,
    rollout: TensorDictBase,
    plans: AnyPlans | None = None,
    *,
    seed: int | None = None,
    name: str | None = None,
    policy: str | None = None,
    failure: Failure | Sequence[Failure | None] | None = None,
    tasks: Iterable[Task] = (),
    suite: str | Suite | None = None,
) -> Any:
    """Add a rollout to a recording: the robot in 3-D, a verdict, the plan at the cursor, the timeline and curves.

    If ``seed`` is given, the episode is re-simulated from the task, ``seed``, ``episode`` and actions to show the
    robot's motion. If the simulated observations are not bit-identical to the recorded ones, a warning is issued, and a
    simplified hand above a table is drawn instead of the robot, as when no ``seed`` is given.

    Args:
        logger: the logger of the recording.
        rollout: one episode of batch size (T,), starting at the first state, or N episodes of batch size (N, T). The
            keys are "observation" T×39 float32 (metres), "task_id" T int64, "action" T×4 float32 in [-1, 1] (as
            executed) and ("next", "success") T×1 bool. Optional keys are ("next", "executed_action") T×4, which
            replaces the action, "episode" T int64, "qaf" T×S bool, "qaf_plan" T int64, "qaf_logits" T×S float32
            (positive: true), "skill_weights" T×S float32, ("next", "reward") T×1 float32 and
            "pixels" T×H×W×3 uint8 (the policy's input).
        plans: the plans whose conditions are evaluated in ``qaf``; None without plans.
        seed: the environment's seed, which determines the initial state together with ``episode``.
        name: the episode's name in the recording, for batch size (T,); None to use the task and episode ("push-7").
        policy: the policy's name, shown in the tab.
        failure: the cause of the episode's failure, shown in the verdict; for N episodes, a list with one entry each.
        tasks: custom tasks that the plans do not define.
        suite: the suite in which the episode is re-simulated; None for the registered suite that has the task.

    Returns:
        The episode's name, or a list of names for N episodes.

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
        failures = failure if isinstance(failure, Sequence) else [failure] * len(rollout)
        same: dict[str, Any] = {"seed": seed, "policy": policy, "tasks": list(tasks), "suite": suite}
        rows = zip(rollout, failures, strict=True)
        return [log_rollout(logger, row, plans, failure=row_failure, **same) for row, row_failure in rows]
    if isinstance(failure, Sequence):
        raise TypeError(f"failure must be a Failure for a rollout of one episode, got {len(failure)} entries")
    if suite is not None:
        suite = load_suite(suite)
        tasks = [*tasks, *suite.tasks.values()]
    heading, episode = read_rollout(rollout, plans, seed=seed, policy=policy, failure=failure, tasks=tasks, suite=suite)
    suite = suite or known_suite(heading.task)
    motion, ghost = _motion(heading, episode, suite), None
    if failure is not None and failure.mended is not None:
        by, plan, steps = failure.mended
        other, mended = read_rollout(steps, Plans([plan]), seed=seed, tasks=tasks, suite=suite)
        ghost = Ghost(replacement_text(by), mended, None if motion is None else _motion(other, mended, suite))
    return logger.add_page(heading, episode, motion=motion, ghost=ghost, name=name)


def read_rollout(
    rollout: TensorDictBase,
    plans: AnyPlans | None = None,
    *,
    seed: int | None = None,
    policy: str | None = None,
    failure: Failure | None = None,
    tasks: Iterable[Task] = (),
    suite: Suite | None = None,
    step_time: float | None = None,
) -> tuple[Heading, RecordedEpisode]:
    """Validate a rollout (T,) (see :func:`log_rollout`), and return its heading and the recorded episode."""
    plans = None if plans is None else as_plans(plans)
    number = _constant(rollout, "task_id", required=True)
    index = _constant(rollout, "episode", required=seed is not None)
    assert number is not None
    defined = [*tasks, *(plan.definition for plan in (plans or {}).values())]
    task = next((task for task in defined if task_id(task.name) == number), None)
    if task is None and 0 <= number < len(MT50):
        task = TASKS[MT50[number]]
    label = f"task-{number}" if task is None else task.name
    plan = None
    if plans is not None:
        plans.require([label])
        plan = plans[label]
        plan_numbers = rollout.get("qaf_plan", None)
        if plan_numbers is not None and not bool((plan_numbers == Plans([plan]).numbers[label]).all()):
            raise ValueError(f"plans must hold the plan for {label!r} from which rollout['qaf'] was computed")
    if failure is not None and (failure.task, failure.episode) != (label, failure.episode if index is None else index):
        failed = f"{failure.task} {failure.episode}"
        raise ValueError(f"failure must describe the rollout's episode ({label} {index}), got {failed}")
    observation = rollout.get("observation", None)
    objects: dict[str, Tensor] = {}
    if task is not None and observation is not None and observation.shape[1:] == (task.layout.size,):
        texts = [] if plan is None else [f"{step.condition} {step.skill}" for step in plan.steps]
        for name, position in task.positions(observation).items():
            if plan is None or name == GRIPPER or any(name in text for text in texts):
                objects[name] = position
    layout, suite = METAWORLD if task is None else task.layout, suite or known_suite(label)
    step_time = step_time or (STEP_TIME if suite is None else suite.step_time)
    episode = RecordedEpisode.from_rollout(rollout, objects, plan, layout, step_time)
    if task is not None and plan is not None:
        episode = episode.with_target_poses(task, suite)
    return Heading(label, index, seed, policy, failure), episode


class DiffersError(ValueError):
    """An error for a re-simulated episode that differs from the recorded one. The message gives the first time step
    that differs, and the difference."""


def simulate_again(
    task: str,
    seed: int,
    episode: int,
    action: NDArray[np.float32],
    observation: NDArray[np.float32],
    suite: Suite | None = None,
) -> Motion | None:
    """Re-simulate an episode from its executed actions (T, A) and return the motion (T + 1 rows).

    Return None if the engine has no ``poses``. Raise a :class:`DiffersError` unless the simulated observations (T, D)
    are bit-identical to the recorded ones.
    """
    suite = load_suite("metaworld") if suite is None else suite
    engine: Any = suite.make_engine([task], reward="sparse", num_threads=1)
    try:
        if not hasattr(engine, "poses"):
            return None
        simulated = engine.reset([0], [episode_seed(suite.tasks[task], seed, episode)])[0].astype(np.float32)
        shape, active = (len(action) + 1, engine.row_model(0).model.nbody), np.ones(1, bool)
        positions, quaternions = np.empty((*shape, 3), np.float32), np.empty((*shape, 4), np.float32)
        touched = []
        for step in range(len(action) + 1):
            positions[step], quaternions[step] = engine.poses(0)
            touched.append(engine.touched(0) if hasattr(engine, "touched") else None)
            if step == len(action):
                break
            if not np.array_equal(simulated, observation[step]):
                error = np.abs(simulated.astype(np.float64) - observation[step])
                raise DiffersError(f"step {step}: observation value {error.argmax()} differs by {error.max():.3g}")
            simulated = engine.step(action[step : step + 1], active).observation[0].astype(np.float32)
        bodies = None if None in touched else tuple(map(str, touched))
        return Motion(engine.row_model(0), positions, quaternions, bodies)
    finally:
        engine.close()


def _motion(heading: Heading, episode: RecordedEpisode, suite: Suite | None) -> Motion | None:
    if heading.seed is None or heading.episode is None or suite is None or episode.observation is None:
        return None
    try:
        return simulate_again(heading.task, heading.seed, heading.episode, episode.action, episode.observation, suite)
    except DiffersError as error:
        label = f"{heading.task}, episode {heading.episode} of seed {heading.seed}"
        warnings.warn(
            f"the re-simulation of {label} differs at {error}; a hand over a table is drawn instead of the robot. "
            "Check that the seed is correct and that the rollout holds the executed actions",
            stacklevel=3,
        )
        return None


def _constant(rollout: TensorDictBase, key: str, *, required: bool) -> int | None:
    """Return the value of an integer column, which must be the same in all rows; None if an optional key is missing."""
    if (column := rollout.get(key, None)) is None:
        if required:
            raise missing_keys(rollout.keys(True, True), key)
        return None
    length = tuple(rollout.batch_size)
    if column.is_floating_point() or tuple(column.shape) not in (length, (*length, 1)):
        actual = f"{column.dtype} {tuple(column.shape)}"
        raise ValueError(f"rollout[{key!r}] must be integers of shape {length}, got {actual}")
    values = torch.unique(column).tolist()
    if len(values) != 1:
        raise ValueError(f"rollout must be one episode of one task, got {key!r} {values[:5]}; split the rollout")
    return int(values[0])


def run_recorded(
    actor: Any,
    tasks: str | Task | Iterable[str | Task],
    *,
    plans: Plans | None = None,
    seed: int,
    episodes: Sequence[int] = (0,),
    noise_scale: float = 0.1,
    max_steps: int | None = None,
    suite: str | Suite | None = None,
    engine: Any = None,
    evaluator: QueryEvaluator | None = None,
    stop_at_success: bool = False,
    device: str | torch.device | None = None,
    progress: bool = False,
) -> list[FinishedEpisode]:
    """Run episodes as :func:`lw_torchrl.evaluate` does, and keep all keys that :func:`lw_torchrl.log_rollout` shows.

    ``episodes`` are indices of each task's episodes; see :func:`lw_torchrl.evaluate` for the other arguments. Return
    the episodes, sorted by task (in the given order) and index. With an evaluator, the steps hold both the evaluator's
    and the exact truth values of the conditions.
    """
    own_plans = actor_plans(actor, plans)
    own_suite, chosen = suite_tasks(tasks, own_plans, suite)
    options: dict[str, Any] = {"seed": seed, "max_steps": max_steps, "suite": own_suite, "engine": engine}
    learned = [evaluator] if isinstance(evaluator, QueryEvaluator) else evaluators_of(actor)
    has_answers = own_plans is not None and (evaluator is not None or bool(learned))
    finished: dict[tuple[str, int], FinishedEpisode] = {}

    def keep(episode: FinishedEpisode) -> None:
        steps = episode.steps
        if learned and "qaf_logits" not in steps.keys():
            steps = learned[0](steps.to(device_of(learned[0]))).cpu()
        if has_answers and own_plans is not None:  # add exact truth values to the evaluator's
            if "qaf_logits" not in steps.keys():
                steps.set("qaf_logits", 10.0 * steps.get("qaf").float() - 5.0)
            answer = QAFTransform(own_plans)
            if answer.program.num_latches:
                trajectory = torch.zeros_like(steps.get("task_id"))
                latches = latches_of_rows(answer.program, steps.get("observation"), steps.get("task_id"), trajectory)
                steps.set(answer.out_keys[2], latches)
            steps = answer(steps)
        finished[episode.task, episode.episode] = episode._replace(steps=steps)

    optional = [*(_PLAN_KEYS if own_plans is not None else ()), *(learned[0].in_keys if learned else ()), "pixels"]
    run: dict[str, Any] = {"noise_scale": noise_scale, "after_success": 0 if stop_at_success else None}
    run |= {"plans": own_plans, "evaluator": evaluator, "env_options": options, "device": device, "progress": progress}
    run_rollout("recording", actor, chosen, dict.fromkeys(chosen, episodes), keep, keys=_KEYS, optional=optional, **run)
    return [finished[task, episode] for task in chosen for episode in episodes]


@contextmanager
def new_recording(path: AnyPath) -> Iterator[RerunLogger]:
    """Yield a logger whose file replaces ``path`` when the block ends; after an error, the old file is unchanged."""
    with replacing(path) as file:
        with RerunLogger(file) as logger:
            yield logger
        if not is_complete(file):
            message = "could not be written completely; check whether the disk is full"
            raise OSError(f"recording {os.fspath(path)!r} {message}")


def write_recording(
    path: AnyPath, episodes: Iterable[FinishedEpisode], plans: Plans | None = None, **options: Any
) -> None:
    """Write the episodes returned by :func:`run_recorded` to a Rerun file, replacing an existing file. ``options`` are
    passed to :func:`lw_torchrl.log_rollout`."""
    with new_recording(path) as logger:
        for episode in episodes:
            log_rollout(logger, episode.steps, plans, **options)
