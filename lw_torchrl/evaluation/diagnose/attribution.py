"""attribute_failures: why episodes failed, by re-running them with one part of the policy replaced."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase

from lw_torchrl._util.checks import Count, Scale, missing_keys, typed
from lw_torchrl._util.devices import device_of
from lw_torchrl.envs.episodes import FinishedEpisode
from lw_torchrl.evaluation.diagnose.counterfactuals import Counterfactuals, own_evaluators
from lw_torchrl.evaluation.diagnose.decision import MARGIN, decide
from lw_torchrl.evaluation.diagnose.failure import Failure
from lw_torchrl.evaluation.diagnose.findings import Difference, Finding
from lw_torchrl.evaluation.diagnose.rerun import EpisodeId, Rerun, null_control
from lw_torchrl.evaluation.diagnose.scripts import Scripts
from lw_torchrl.evaluation.diagnose.states import EpisodeStates, Explanation, explain, stall_step, states_of
from lw_torchrl.language.plans import AnyPlans, Plans, as_plans
from lw_torchrl.language.skills import ScriptedSkill, load_skills
from lw_torchrl.language.tasks import task_id
from lw_torchrl.modules.parts import evaluating
from lw_torchrl.modules.policy import plans_of
from lw_torchrl.suites.suite import Suite, find_suite


@typed
def attribute_failures(
    rollouts: Iterable[FinishedEpisode | TensorDictBase],
    plans: AnyPlans,
    *,
    actor: Callable[[TensorDictBase], TensorDictBase] | None = None,
    reference: AnyPlans | None = None,
    evaluator: Callable[[TensorDictBase], TensorDictBase] | None = None,
    skills: Mapping[str, ScriptedSkill] | None = None,
    seed: int,
    noise_scale: Scale = 0.1,
    max_steps: Count | None = None,
    num_envs: Count | None = None,
    suite: str | Suite | None = None,
    engine: Any = None,
    num_threads: int | None = None,
    device: str | torch.device | None = None,
    progress: bool = True,
) -> list[Failure]:
    """Find the cause of each failed episode: the observations, the answers, the plan, a skill, another part of the
    policy, or the time limit.

    **A rule reads the states.** The cause is *query* if the policy acted on wrong answers; else *plan* if, late in the
    episode, the plan requests something else than the reference plan; else *skill*. This is no proof: a plan that
    differs from the reference may succeed. Without a reference the rule recognises only wrong answers, a plan of which
    no condition holds, and a skill that stays far from its target. Without ``actor``, only the rule is used.

    **A counterfactual decides**, with ``actor``. First the null control: the same episode is re-run, with the same
    noise and nothing replaced. If it succeeds, the failure is *not reproducible*, and the finding says what differs.
    Otherwise it is re-run with one part replaced by a sound one: the observations, if the policy was shown wrong ones
    (*perception*); the answers, where they were wrong (*query*); the *plan*, by the reference; the policy's action, by
    that of scripted skills or, where a step has none, the expert's, in one step of the plan (*skill*), for the
    *gripper* or the hand's motion (*actuation*) only, or in all steps (*policy*); or twice the time (*out of time*). If
    nothing helps, pairs are tried, which give ``cause`` and ``also``. If several replacements help, the one that fixes
    most of the task's failed episodes counts, and of those about as good the smallest; but a skill does not count if
    other steps have the same fault. For a policy without plans, no step is reported.

    Args:
        rollouts: episodes as :func:`evaluate` passes them to ``on_episode``, or TensorDicts of batch (T,), each one
            episode from its first state on; successful ones are skipped. Keys: ``observation`` (T, 39) float32,
            ``task_id`` (T,) int64, ``("next", "success")`` (T, 1) bool; of a TensorDict ``episode`` (T,) int64.
            Optional: the answers that the policy acted on, ``qaf_logits`` (T, S) float32, else ``qaf`` (T, S) bool;
            ``skill_weights`` (T, S) float32, for the active step.
        plans: the plans that were carried out.
        actor: the policy; the counterfactuals of a stochastic policy are less reliable.
        reference: trusted plans for some of the tasks.
        evaluator: as for :func:`evaluate`; an evaluator inside the policy is found there.
        skills: trusted scripted skills by text; None for the suite's, :func:`load_skills` of Meta-World.
        seed, noise_scale, max_steps, suite, engine: those of the episodes. An episode that was cut before ``max_steps``
            is run to its end: if it then succeeds, it is not reproducible.
        num_envs, num_threads, device, progress: as for :func:`evaluate`.

    Returns:
        A :class:`Failure` for each failed episode, in the order of the rollouts.

    Raises:
        ValueError: a rollout lacks a key, an episode occurs twice, a task has no plan, the plans are not the actor's,
            or an episode does not begin as (task, seed, episode) does.

    Example:
        >>> import lw_torchrl as lw
        >>> from dataclasses import replace
        >>> plans = lw.Plans({"reach": lw.load_plans("MT10")["reach"]})
        >>> skills, text = lw.load_skills(), plans["reach"].steps[1].skill
        >>> faulty = {**skills, text: replace(skills[text], offset=(0.1, 0.0, 0.0))}
        >>> actor, episodes = lw.ScriptedSkillActor(plans, skills=faulty), []
        >>> run, keys = {"seed": 1_000, "max_steps": 100}, ["observation", "task_id", "qaf", "skill_weights"]
        >>> record = {"also_record": keys, "on_episode": episodes.append}
        >>> _ = lw.evaluate(actor, tasks="reach", episodes_per_task=1, **run, **record)
        >>> [failure] = attribute_failures(episodes, plans, actor=actor, **run)
        >>> failure.cause, failure.counterfactuals
        ('skill', {'skill': True})

    Source: the plan's conditions, its steps and their execution are separate, so each can be replaced.
    """
    answered = as_plans(plans)
    if actor is not None and (own := plans_of(actor)) is not None and (other := answered.differences(own)):
        raise ValueError(f"plans differ from the actor's own for {', '.join(other)}; pass the actor's plans")
    if not isinstance(rollouts, Iterable):
        raise TypeError(f"rollouts must be a list of finished episodes, got {type(rollouts).__name__}")
    failed = _failed(rollouts, answered)
    if not failed:
        return []
    names = sorted({task for task, _, _ in failed})
    own_suite = find_suite(names, suite)
    table = (own_suite.skills or load_skills()) if skills is None else skills
    given = {} if reference is None else as_plans(reference, "reference")
    others = {task: plan for task, plan in given.items() if task in names}
    seen = [states_of(task, k, steps, answered, _answers(steps, actor)) for task, k, steps in failed]
    scripts, theirs = Scripts(answered, table), Scripts(Plans(others), table) if others else None
    explained = [(one, explain(one, scripts, theirs)) for one in seen]
    if actor is None:
        return [_by_rule(*both, seed) for both in explained]
    tasks = {name: own_suite.tasks.get(name, answered[name].definition) for name in names}
    env_options = {"seed": seed, "suite": own_suite, "engine": engine, "num_threads": num_threads}
    env_options["max_steps"] = own_suite.max_steps if max_steps is None else max_steps
    rerun = Rerun(tasks, env_options, noise_scale, num_envs, device, progress)
    null = null_control(rerun, {one.which: one.steps for one in seen}, actor, answered, evaluator)
    tried = Counterfactuals(actor, evaluator, None if theirs is None else theirs.plans, scripts, rerun, null)
    tried.run(seen, [one.which for one, explanation in explained if explanation.evidence.get("plan_departs") == 0.0])
    shares = tried.shares()
    return [_by_counterfactuals(*both, tried, shares.get(both[0].task, {}), seed) for both in explained]


def _failed(rollouts: Iterable[Any], plans: Plans) -> list[tuple[str, int, TensorDictBase]]:
    """Return task, episode and steps of each failed episode."""
    by_id = {task_id(task): task for task in plans}
    failed: list[tuple[str, int, TensorDictBase]] = []
    seen: set[EpisodeId] = set()
    for place, rollout in enumerate(rollouts):
        steps, number = (rollout.steps, rollout.episode) if isinstance(rollout, FinishedEpisode) else (rollout, None)
        if not isinstance(steps, TensorDictBase) or steps.batch_dims != 1 or not len(steps):
            what = type(steps).__name__
            raise ValueError(f"rollouts[{place}] must be a finished episode, or a TensorDict of batch (T,), got {what}")
        needed = ["observation", "task_id", ("next", "success"), *(["episode"] if number is None else [])]
        if missing := [key for key in needed if steps.get(key, None) is None]:
            raise missing_keys(steps.keys(True, True), *(str(key) for key in missing))
        tasks = steps.get("task_id").unique().tolist()
        if len(tasks) != 1 or tasks[0] not in by_id:
            raise ValueError(f"rollouts[{place}] must be of one task that plans has, {', '.join(plans)}; got {tasks}")
        episodes = steps.get("episode").unique().tolist() if number is None else [number]
        if len(episodes) != 1:
            raise ValueError(f"rollouts[{place}] must be one episode, got {len(episodes)}: split them")
        which = by_id[tasks[0]], episodes[0]
        if which in seen:
            raise ValueError(f"rollouts[{place}] is episode {which[1]} of {which[0]!r} again")
        seen.add(which)
        if not steps.get(("next", "success")).any():
            failed.append((*which, steps))
    return failed


def _answers(steps: TensorDictBase, actor: Any) -> Tensor | None:
    """Return the answers (T, S) of the evaluators inside a policy, the mean of several; None without an evaluator."""
    evaluators = own_evaluators(actor)
    if not evaluators or "qaf_logits" in steps.keys():
        return None
    read = dict.fromkeys(key for one in evaluators for key in one.in_keys)
    if missing := ", ".join(str(key) for key in read if steps.get(key, None) is None):
        needed = f"rollouts must hold {missing}, which the policy's evaluator reads, or its answers, qaf_logits"
        raise ValueError(f"{needed}; evaluate(..., attribute=True) records them")
    with torch.no_grad(), evaluating(actor):
        device = device_of(actor)
        logits = [one.logits(*(steps.get(key).to(device) for key in one.in_keys)) for one in evaluators]
    return torch.stack(logits).mean(0).cpu() > 0


def keys_to_attribute(actor: Any, env: EnvBase) -> list[NestedKey]:
    """Return the keys of each step that attribution reads, as far as environment and actor write them."""
    there = set(env.full_observation_spec.keys(True, True))
    keys = [key for key in getattr(actor, "in_keys", ()) if key in there]
    return ["observation", "task_id", "qaf", *keys, "skill_weights", "qaf_logits"]


def _by_rule(one: EpisodeStates, explanation: Explanation, seed: int) -> Failure:
    """Return the failure as the states alone show it."""
    cause, blames, evidence = explanation
    return Failure(one.task, seed, one.episode, cause, None, *blames[cause], evidence=evidence)


def _by_counterfactuals(
    one: EpisodeStates, explanation: Explanation, tried: Counterfactuals, shares: Mapping[str, float], seed: int
) -> Failure:
    """Return the failure as the counterfactuals show it, with findings from the states."""
    which, null = one.which, tried.null
    share, number = null.share(one.task), float(sum(task == one.task for task, _ in null.episodes))
    record: dict[str, Any] = {"evidence": {**explanation.evidence, "failed": number}}
    record["shares"] = {"nothing": share, **shares}
    if null.succeeds(which) or (which in null.differs and share >= MARGIN):
        first = null.differs.get(which, Difference("nothing", len(one.steps) - 1))
        record["succeeds_at"] = null.episodes[which].first_success
        return Failure(one.task, seed, one.episode, "not reproducible", None, None, first.at, first, **record)
    tried_here = {name: results[which] is not None for name, results in tried.results.items() if which in results}
    record["counterfactuals"] = tried_here
    same = explanation.evidence.get("plan_departs") == 0.0
    counting = [name for name in tried.mending(one) if not (same and name == "plan")]
    decision = decide(counting, shares, share)
    cause, also, mended = decision.cause, decision.also, tried.mended(decision, which)
    only = tried.step_of_motion(one) if cause == "actuation" else None
    cause = cause if only is None else "skill"
    if mended is not None:
        record |= {"replaced": decision.by, "rival": decision.rival, "succeeds_at": len(mended.steps), "mended": mended}
        if cause == "actuation" and tried_here.get("skill") and "skill" not in counting:
            record["scripted_step"] = tried.step[which]
    elif explanation.cause == "query" and "query" not in tried_here and not (same and tried_here.get("plan")):
        cause = "query"
    step: int | None
    shown: Finding | None
    step, at, shown = explanation.blames.get(cause, explanation.blames["undecided"])
    if cause == "skill" and also is None:
        step, plan = tried.step[which] if only is None else only, tried.plans[one.task]
        at, shown = stall_step(one, step, plan.definition.layout), one.active_time(plan, step)
    elif cause == "perception":
        shown = null.misled[which]
    elif cause == "undecided" and explanation.cause != "undecided":
        record["suspect"], shown = explanation.cause, explanation.blames[explanation.cause].finding
    if plans_of(tried.actor) is None and cause != "query":
        step = None
    shown = None if step is None and cause != "perception" else shown
    return Failure(one.task, seed, one.episode, cause, also, step, at, shown, **record)
