"""evaluate: run exactly k episodes of each task, from the same initial states for every actor."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey

from lw_torchrl._util.checks import Count, Scale, typed
from lw_torchrl._util.keys import check_key
from lw_torchrl.envs.episodes import FinishedEpisode
from lw_torchrl.evaluation.diagnose.attribution import attribute_failures, keys_to_attribute
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
    tasks: str | Task | Iterable[str | Task],
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
    progress: bool = True,
    also_record: Sequence[NestedKey] = (),
    on_episode: Callable[[FinishedEpisode], object] | None = None,
    device: str | torch.device | None = None,
    evaluator: Callable[[TensorDictBase], TensorDictBase] | None = None,
    attribute: bool = False,
    reference: AnyPlans | None = None,
) -> EvaluationResult:
    """Run episodes 0 to k - 1 of each task and return their results.

    The actor runs in eval mode with deterministic exploration. The executed action is its action plus
    N(0, noise_scale²) on each of its entries, clipped. The result depends neither on ``num_envs`` nor on the other
    tasks: the actor runs on blocks of a fixed number of rows, and all randomness comes from (task, seed, episode).

    Args:
        actor: reads ``observation``, ``task_id`` and, if it has plans, ``qaf``; writes ``action`` (N, 4) float32.
        tasks: as for :func:`resolve_tasks`; for an actor that knows its tasks, some of them.
        plans: the plans whose conditions are answered; None for the actor's own.
        episodes_per_task: k.
        seed: random seed (use a different one than for the demonstrations).
        noise_scale: standard deviation of the action noise.
        num_envs: environments stepped together, at least the number of tasks; by default about 256.
        stop_at_success: end an episode at its first success; success at the end and return are then None.
        record_actions: keep each episode's executed actions, (T, 4) float32.
        reward: "sparse" or "dense", summed in the return.
        max_steps, suite, engine, num_threads: as for :class:`LanguageWorldEnv`.
        progress: show a progress bar if it takes longer than a second.
        also_record: more keys to pass to ``on_episode``: "qaf", "skill_weights".
        on_episode: called with each finished episode, a named tuple of ``task``, ``episode`` (its index) and ``steps``,
            a TensorDict of batch (T,): ``action``, ``("next", "success")``, ``("next", "reward")``, ``also_record``.
        device: the actor's device, to which it is moved: "cpu", "cuda", "cuda:1", "mps" or "auto"; None leaves it where
            it is. The environment and its queries are always on the CPU.
        evaluator: a module, function or transform in front of the actor that answers the conditions, such as
            :class:`~lw_torchrl.transforms.CorruptQAF`; None for exact answers at every step.
        attribute: find the causes of failed episodes, see :func:`attribute_failures`: ``.failures`` of the result.
        reference: trusted plans for the same tasks, with which failed episodes are re-run.

    Warns:
        UserWarning: a simulation became unstable, which ends its episode; the actor cannot follow the reference.

    Raises:
        ValueError: the plans differ from the actor's, a task has no plan or is not among the actor's, nothing writes a
            key in ``also_record``, or an action is NaN.

    Example:
        >>> import lw_torchrl as lw
        >>> result = lw.evaluate(lw.ExpertActor("reach"), tasks="reach", episodes_per_task=2, seed=1_000)
        >>> result.success_once
        {'reach': 1.0}

    Source: paper section 'Conditional Plan Experiments': 20 episodes, action noise 0.1.
    """
    answered = actor_plans(actor, plans)
    own_suite, chosen = suite_tasks(tasks, answered, suite)
    names = tuple(chosen)
    if answered is not None:
        answered.require(names)
    known = tasks_of(actor)
    if known is not None and (other := ", ".join(task for task in names if task not in known)):
        raise ValueError(f"tasks must be among the actor's, {', '.join(known)}; the actor does not know {other}")
    if attribute and answered is None:
        raise ValueError("attribute=True needs plans: pass plans, or an actor that has plans")
    if reference is not None and not attribute:
        raise ValueError("reference is only used with attribute=True, which re-runs failed episodes with it")
    if isinstance(also_record, str):
        raise TypeError(f"also_record must be a list of keys, got the string {also_record!r}")
    for key in also_record:
        check_key("also_record", key)
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
        optional=(lambda env: keys_to_attribute(actor, env)) if attribute else (),
        after_success=0 if stop_at_success else None,
        **run,
    )
    config = {"tasks": list(names), "episodes_per_task": episodes_per_task, "noise_scale": noise_scale, **shared}
    config |= {"stop_at_success": stop_at_success, "reward": reward}
    failures = None
    if attribute and answered is not None:
        # Episodes finish in an order that depends on the number of environments.
        failed.sort(key=lambda episode: episode[:2])
        parts: dict[str, Any] = {"actor": actor, "reference": reference, "evaluator": evaluator}
        failures = tuple(attribute_failures(failed, answered, **parts, **env_options, **run))
    return EvaluationResult(config, tuple(sorted(results, key=lambda e: (e.task, e.episode))), failures=failures)
