"""evaluate: run exactly k episodes of each task, from the same initial states for every actor."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey

from lw_torchrl._util.checks import Count, Scale, typed
from lw_torchrl.envs.episodes import FinishedEpisode
from lw_torchrl.evaluation.diagnose.attribution import attribute_failures
from lw_torchrl.evaluation.result import EpisodeResult, EvaluationResult
from lw_torchrl.evaluation.rollout import actor_plans, rollout, suite_tasks
from lw_torchrl.language.plans import AnyPlans
from lw_torchrl.language.tasks import Task
from lw_torchrl.modules.policy import tasks_of
from lw_torchrl.suites.suite import Suite


@typed
def evaluate(
    actor: TensorDictModuleBase | Callable[[TensorDictBase], TensorDictBase],
    *,
    tasks: str | Task | Iterable[str | Task] | None = None,
    plans: AnyPlans | None = None,
    episodes_per_task: Count = 20,
    seed: int,
    noise_scale: Scale = 0.1,
    num_envs: int | None = None,
    stop_at_success: bool = False,
    record_actions: bool = False,
    reward: Literal["sparse", "dense"] = "sparse",
    max_steps: Count | None = None,
    suite: str | Suite | None = None,
    engine: Any = None,
    num_threads: int | None = None,
    workers: Count | None = None,
    progress: bool = True,
    also_record: Sequence[NestedKey] = (),
    on_episode: Callable[[FinishedEpisode], object] | None = None,
    device: str | torch.device | None = None,
    evaluator: Callable[[TensorDictBase], TensorDictBase] | None = None,
    attribute: bool = False,
    reference: AnyPlans | None = None,
) -> EvaluationResult:
    """Run episodes 0 to k - 1 of each task and return their results.

    The actor runs in eval mode with deterministic exploration. The executed action is the actor's action plus
    N(0, noise_scale²) noise on each entry, clipped. A task's results depend neither on ``num_envs`` or ``workers`` nor
    on the other tasks: the actor runs on blocks of a fixed number of rows, and all randomness comes from (task, seed,
    episode).

    Args:
        actor: a policy that reads ``observation``, ``task_id`` and, if it has plans, ``qaf``, and writes ``action``
            (N, 4) float32.
        tasks: see :func:`resolve_tasks`; if the actor lists its tasks, a subset of that list. None for all of the
            actor's tasks, or the tasks of its plans.
        plans: the plans whose conditions are evaluated into ``qaf``; None for the actor's plans.
        episodes_per_task: the number k of episodes.
        seed: random seed (use a different one than for the demonstrations).
        noise_scale: standard deviation of the action noise.
        num_envs: number of environments stepped together (at least the number of tasks); None for about 256.
        stop_at_success: end an episode at its first success; ``success_at_end`` and ``episode_return`` are then None.
        record_actions: keep the executed actions of each episode, (T, 4) float32.
        reward: the reward summed in the return, "sparse" or "dense".
        max_steps, suite, engine, num_threads: see :class:`LanguageWorldEnv`.
        workers: number of processes to split the episodes over, 1 for this process only; None for one per core if that
            saves time (from about 300,000 time steps on two cores, 70,000 on 16). With None, episodes with a function,
            a stochastic policy, a policy on a GPU or a custom engine run in this process.
        progress: show a progress bar if the evaluation takes longer than a second.
        also_record: more keys to pass to ``on_episode``, for example "qaf" or "skill_weights".
        on_episode: called with each finished episode, a named tuple of ``task``, ``episode`` (index) and ``steps``, a
            TensorDict of batch (T,): ``action``, ``("next", "success")``, ``("next", "reward")``, ``also_record``.
        device: device to move the actor to: "cpu", "cuda", "cuda:1", "mps" or "auto"; None does not move the actor.
            The environment and its queries always run on the CPU.
        evaluator: a module, function or transform that runs before the actor and answers the conditions, such as
            :class:`~lw_torchrl.transforms.CorruptQAF`; None for exact answers at every time step.
        attribute: find the causes of failed episodes with :func:`attribute_failures`, and store them in ``failures``.
        reference: trusted plans for the same tasks, with which failed episodes are re-run.

    Warns:
        UserWarning: a simulation became unstable, which ends the episode; or the actor cannot follow the reference.

    Raises:
        ValueError: the plans differ from the actor's plans, a task has no plan or is unknown to the actor, neither
            environment nor policy writes a key in ``also_record``, or an action is NaN.

    Example:
        >>> import lw_torchrl as lw
        >>> result = lw.evaluate(lw.ExpertActor("reach"), tasks="reach", episodes_per_task=2, seed=1_000)
        >>> result.success_once
        {'reach': 1.0}

    Source: paper section 'Conditional Plan Experiments': 20 episodes, action noise 0.1.
    """
    answered, known = actor_plans(actor, plans), tasks_of(actor)
    if tasks is None and (tasks := known or answered) is None:
        raise ValueError("tasks is required: the actor has neither tasks nor plans; pass tasks='MT10', for example")
    own_suite, chosen = suite_tasks(tasks, answered, suite)
    names = tuple(chosen)
    if answered is not None:
        answered.require(names)
    if known is not None and (other := ", ".join(task for task in names if task not in known)):
        raise ValueError(f"tasks must be among the actor's tasks ({', '.join(known)}), got {other}")
    if attribute and answered is None:
        raise ValueError("attribute=True requires plans: pass plans, or an actor that has plans")
    if reference is not None and not attribute:
        raise ValueError("reference requires attribute=True, which re-runs failed episodes with the reference plans")
    shared: dict[str, Any] = {"seed": seed, "max_steps": max_steps or own_suite.max_steps}
    env_options = shared | {"suite": own_suite, "engine": engine, "num_threads": num_threads}
    run: dict[str, Any] = {"noise_scale": noise_scale, "num_envs": num_envs, "device": device, "progress": progress}
    results: list[EpisodeResult] = []
    failed: list[FinishedEpisode] = []

    def keep(finished: FinishedEpisode) -> None:
        first, steps = finished.first_success, finished.steps
        at_end = None if stop_at_success else bool(steps.get(("next", "success"))[-1])
        total = None if stop_at_success else float(steps.get(("next", "reward")).double().sum())
        actions = steps.get("action").clone() if record_actions else None
        results.append(EpisodeResult(*finished[:2], first is not None, first, at_end, total, actions))
        if attribute and first is None:
            failed.append(finished)
        if on_episode is not None:
            on_episode(finished)

    rollout(
        "evaluating",
        actor,
        chosen,
        dict.fromkeys(names, range(episodes_per_task)),
        keep,
        plans=answered,
        evaluator=evaluator,
        env_options=env_options | {"reward": reward},
        keys=["action", ("next", "success"), ("next", "reward"), *also_record],
        optional=["observation", "task_id"] if attribute else (),
        after_success=0 if stop_at_success else None,
        workers=workers,
        **run,
    )
    config = {"tasks": list(names), "episodes_per_task": episodes_per_task, "noise_scale": noise_scale, **shared}
    config |= {"stop_at_success": stop_at_success, "reward": reward}
    failures = None
    if attribute and answered is not None:
        # Sort the episodes, because the order in which they finish depends on the number of environments.
        failed.sort(key=lambda episode: episode[:2])
        parts: dict[str, Any] = {"actor": actor, "reference": reference, "evaluator": evaluator}
        failures = tuple(attribute_failures(failed, answered, **parts, **env_options, **run))
    return EvaluationResult(config, tuple(sorted(results, key=lambda e: (e.task, e.episode))), failures=failures)
