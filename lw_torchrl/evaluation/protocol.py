"""evaluate: exactly k episodes of each task, the same initial states for every actor."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torchrl.envs import EnvBase

from lw_torchrl._checks import Count, Scale, check_int, checked, unknown_name
from lw_torchrl._keys import check_key
from lw_torchrl.envs.episodes import FinishedEpisode, read_action
from lw_torchrl.envs.language_world_env import LanguageWorldEnv
from lw_torchrl.evaluation.attribution import attribute_failures, keys_to_attribute
from lw_torchrl.evaluation.result import EpisodeResult, EvaluationResult
from lw_torchrl.evaluation.running import ROWS, Acts, answered_by, make_env, running
from lw_torchrl.language.plans import AnyPlans, Plans, as_plans
from lw_torchrl.language.tasks import Task, TaskList
from lw_torchrl.modules.policy import plans_of, tasks_of
from lw_torchrl.suites.suite import Suite, find_suite, listed_tasks


def actor_plans(actor: Any, plans: AnyPlans | None) -> Plans | None:
    """The plans to answer queries for: those given, or the actor's own; different ones are an error."""
    own = plans_of(actor)
    if plans is None:
        return own
    given = as_plans(plans)
    if own is not None and (different := given.differences(own)):
        how = "pass plans=None, or evaluate actor.with_plans(plans)"
        raise ValueError(f"plans differ from the actor's own for {', '.join(different)}; {how}")
    return own or given


def named_tasks_of(
    tasks: TaskList, plans: Plans | None, suite: str | Suite | None = None
) -> tuple[Suite, dict[str, Task]]:
    """The suite, and the tasks by name; a name of the user's own stands for the task that its plan is for."""
    tasks = listed_tasks(tasks)
    found = find_suite(tasks, suite)
    own = {} if plans is None else {plan.task: plan.definition for plan in plans.values()}
    return found, found.named_tasks(tasks, {name: task for name, task in own.items() if name not in found.tasks})


def _checked(policy: Acts, env: EnvBase, also_record: Iterable[NestedKey]) -> Acts:
    """``policy``, whose action is checked, and at its first call whether it and ``env`` write ``also_record``."""
    unseen = [unravel_key(key) for key in also_record]
    specs = env.full_observation_spec, env.full_reward_spec, env.full_done_spec
    size = env.action_spec.shape[-1]
    later = [unravel_key(("next", key)) for spec in specs for key in spec.keys(True, True)]

    def run(tensordict: TensorDictBase) -> TensorDictBase:
        tensordict = policy(tensordict)
        read_action(tensordict, size)
        while unseen:
            key = unseen.pop()
            if key not in later and key not in tensordict.keys(True):
                raise unknown_name("also_record", key, [*tensordict.exclude("_step").keys(True, True), *later])
        return tensordict

    return run


@checked
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
    """Run episodes 0 to k - 1 of each task and report how they went.

    The actor runs in eval mode with deterministic exploration. The executed action is its action plus
    N(0, noise_scale²) on all its numbers, clipped. The result depends neither on ``num_envs`` nor on the tasks beside:
    the actor is run on blocks of a fixed number of rows, and all randomness comes from (task, seed, episode).

    Args:
        actor: reads ``observation``, ``task_id`` and, if it has plans, ``qaf``; writes ``action`` (N, 4) float32.
        tasks: as for :func:`resolve_tasks`; of an actor that knows its tasks, among these.
        plans: whose queries to answer; None for the actor's own.
        episodes_per_task: k.
        seed: one that no demonstration was collected with.
        noise_scale: standard deviation of the action noise.
        num_envs: environments stepped together, at least the number of tasks; by default about 256.
        stop_at_success: end an episode at its first success; success at the end and return are then None.
        record_actions: keep each episode's executed actions, (T, 4) float32.
        reward: "sparse" or "dense", summed in the return.
        max_steps, suite, engine, num_threads: as for :class:`LanguageWorldEnv`.
        progress: show a progress bar when it takes longer than a second.
        also_record: more keys for ``on_episode`` to see: "qaf", "skill_weights".
        on_episode: called with each finished episode, a named tuple of ``task``, ``episode`` (its index) and ``steps``,
            a TensorDict of batch (T,): ``action``, ``("next", "success")``, ``("next", "reward")``, ``also_record``.
        device: where the actor works: "cpu", "cuda", "cuda:1", "mps", or "auto"; it is moved there, and stays. None for
            where it is. The environment and its queries are always on the CPU.
        evaluator: answers the conditions in the query answering function's place, as for :func:`attribute_failures`: a
            :class:`~lw_torchrl.CorruptQAF`; None for exact truth at every step.
        attribute: say why episodes failed, see :func:`attribute_failures`: ``.failures`` of the result.
        reference: trusted plans for the same tasks, with which failed episodes are run again.

    Warns:
        UserWarning: a simulation became unstable; its episode ends there, a failure unless it had succeeded. The actor
            cannot carry out the reference.

    Raises:
        ValueError: a wrong argument, plans that differ from the actor's, a task without a plan or not among the
            actor's, a key in ``also_record`` that nobody writes, an actor that gives NaN.

    Example:
        >>> import lw_torchrl as lw
        >>> result = lw.evaluate(lw.ExpertActor("reach"), tasks="reach", episodes_per_task=2, seed=1_000)
        >>> result.success_once
        {'reach': 1.0}

    Source: paper section 'Conditional Plan Experiments': 20 episodes, action noise 0.1.
    """
    answered = actor_plans(actor, plans)
    found_suite, chosen = named_tasks_of(tasks, answered, suite)
    names = tuple(chosen)
    if answered is not None:
        answered.require(names)
    known = tasks_of(actor) or names
    if other := ", ".join(task for task in names if task not in known):
        raise ValueError(f"tasks must be among the actor's, {', '.join(known)}; it was not made for: {other}")
    if attribute and answered is None:
        raise ValueError("attribute must be False for an actor without plans, unless plans are given")
    if reference is not None and not attribute:
        raise ValueError("reference is for attribute=True, which runs failed episodes again with it")
    if isinstance(also_record, str) or not isinstance(also_record, Iterable):
        raise TypeError(f"also_record must be a list of keys, got {also_record!r}")
    for key in (also_record := list(also_record)):
        check_key("also_record", key)
    if num_envs is None:
        num_envs = len(names) * max(1, ROWS // len(names))
    num_envs = min(check_int("num_envs", num_envs), len(names) * episodes_per_task)  # a row more would have no work
    max_steps = found_suite.max_steps if max_steps is None else max_steps
    shared: dict[str, Any] = {"seed": seed, "engine": engine, "num_threads": num_threads, "max_steps": max_steps}
    shared["suite"] = found_suite
    base = LanguageWorldEnv(list(chosen.values()), num_envs=num_envs, reward=reward, strict=True, **shared)
    env = make_env(actor, answered, base, evaluator)
    seen: dict[NestedKey, None] = dict.fromkeys(also_record)
    if attribute:
        seen |= dict.fromkeys(keys_to_attribute(actor, env))
    found: list[EpisodeResult] = []
    failed: list[FinishedEpisode] = []
    how: dict[str, Any] = {"noise_scale": noise_scale, "device": device, "progress": progress}
    options: dict[str, Any] = {"keys": ["action", ("next", "success"), ("next", "reward"), *seen]}
    options |= {"after_success": 0 if stop_at_success else None, "wrap": lambda policy: _checked(policy, env, seen)}
    listed = dict.fromkeys(names, range(episodes_per_task))
    with running("evaluating", env, answered_by(actor, evaluator), listed, **how, **options) as episodes:
        for finished in episodes:
            first, steps = finished.first_success, finished.steps
            at_end = None if stop_at_success else bool(steps.get(("next", "success"))[-1])
            total = None if stop_at_success else float(steps.get(("next", "reward")).double().sum())
            actions = steps.get("action").clone() if record_actions else None
            about = finished.task, finished.episode, first is not None, first, at_end, total, actions
            found.append(EpisodeResult(*about))
            if attribute and first is None:
                failed.append(finished)
            if on_episode is not None:
                on_episode(finished)
    config = {"tasks": list(names), "episodes_per_task": episodes_per_task, "seed": seed, "noise_scale": noise_scale}
    config |= {"stop_at_success": stop_at_success, "reward": reward, "max_steps": max_steps}
    failures = None
    if attribute and answered is not None:
        failed.sort(key=lambda episode: (episode.task, episode.episode))
        given: dict[str, Any] = {"actor": actor, "reference": reference, "evaluator": evaluator, "num_envs": num_envs}
        failures = tuple(attribute_failures(failed, answered, **given, **shared, **how))
    return EvaluationResult(config, tuple(sorted(found, key=lambda e: (e.task, e.episode))), failures=failures)
