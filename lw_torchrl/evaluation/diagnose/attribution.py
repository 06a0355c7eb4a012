"""attribute_failures: find out why episodes failed by re-running them with one part of the policy replaced."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase

from lw_torchrl._util.checks import Count, Scale, missing_keys, typed
from lw_torchrl._util.devices import device_of
from lw_torchrl.envs.episodes import FinishedEpisode
from lw_torchrl.evaluation.diagnose.failure import (
    REPLACEMENTS,
    Cause,
    Difference,
    Failure,
    Finding,
    Misled,
    WrongMotion,
)
from lw_torchrl.evaluation.diagnose.replacements import EpisodeId, Scripts, gripper_of, own_evaluators
from lw_torchrl.evaluation.diagnose.reruns import Rerun, Reruns
from lw_torchrl.evaluation.diagnose.states import EpisodeStates, Explanation, explain, stall_step, states_of
from lw_torchrl.language.plans import AnyPlans, Plans, as_plans
from lw_torchrl.language.skills import ScriptedSkill, load_skills
from lw_torchrl.language.tasks import task_id
from lw_torchrl.modules.parts import evaluating
from lw_torchrl.modules.policy import plans_of
from lw_torchrl.suites.suite import Suite, find_suite

MARGIN = 0.3  # a clear lead of one replacement, as a fraction of the task's failed episodes
_FACTS = (
    "environment",
    "perception",
    "query",
    "wrapper",
)  # tried only after a wrong observation, answer or action was measured
_PARTS = ("skill", "gripper", "actuation", "policy", "plan")  # in the order in which they count
_SEEN = 0.01  # meters by which an observation must be wrong to count if correcting it does not help
_CLEAR = 0.1  # root mean square by which executed actions must differ from the commanded ones


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
    """Find the cause of each failed episode: the environment, the observations, the answers to the plan's conditions,
    the plan, a skill, another part of the policy, the noise, or the time limit.

    Without ``actor``, a rule examines the states: the cause is *query* if the policy acted on wrong answers; *plan* if,
    late in the episode, plan and reference request different actions, or no condition holds; otherwise *skill*.

    With ``actor``, **measurements come first**. Each episode is re-run with the same noise and nothing replaced.

    - *environment differs*: the first state, or the state after the same action, differs from the rollout's, or the
      episode succeeds in the suite's own engine;
    - *not reproducible*: the re-run succeeds, and the finding reports what differs;
    - *perception*: the policy was shown wrong observations; *query*: it acted on wrong answers; and it succeeds with
      the true ones;
    - *actuation* or *gripper*: something around the policy or the environment changed the motion or the gripper's
      command, beyond the noise. If this happened in only one plan step, the cause is *skill*.

    **Replacements decide about what is left.** Scripts take control of the whole policy. If they succeed, the plan is
    sound, and the scripts' actions show what the policy does differently: the *gripper*, the motion in one plan step
    (*skill*) or in all (*actuation*). Scripts for only this part must succeed too, otherwise the cause is *policy*. If
    they fail, the reference *plan* is tried, then twice the time (*out of time*), then pairs, which give ``cause`` and
    ``also``. If the episode succeeds without noise, and this repairs about as many of the task's failed episodes as
    the best replacement, no part is blamed, but the *noise*.

    Args:
        rollouts: episodes as :func:`evaluate` passes them to ``on_episode``, or TensorDicts of batch (T,), each with
            one whole episode; successful episodes are skipped. Keys: ``observation`` (T, 39) float32, ``task_id`` (T,)
            int64, ``("next", "success")`` (T, 1) bool, and, in a TensorDict, ``episode`` (T,) int64. Optional: the
            answers that the policy acted on, ``qaf_logits`` (T, S) float32 or ``qaf`` (T, S) bool; and
            ``skill_weights`` (T, S) float32, which determine the active plan step.
        plans: the plans that the policy followed.
        actor: the policy; re-runs of a stochastic policy are less reliable.
        reference: trusted plans for some of the tasks.
        evaluator: see :func:`evaluate`; an evaluator inside the policy is detected automatically.
        skills: trusted scripted skills by text; None for the suite's skills (:func:`load_skills` for Meta-World).
        seed, noise_scale, max_steps, suite, engine: the settings with which the episodes were run. An episode that was
            cut before ``max_steps`` is re-run to the end; if the re-run succeeds, the failure is *not reproducible*.
        num_envs, num_threads, device, progress: see :func:`evaluate`.

    Returns:
        A :class:`Failure` for each failed episode, in the order of the rollouts.

    Raises:
        ValueError: a rollout lacks a key, an episode occurs twice, a task has no plan, or the plans differ from the
            actor's plans.

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
        ('skill', {'no noise': False, 'policy': True, 'skill': True})

    Source: a plan's conditions, skills and skill execution are separate in the policy, so each can be replaced.
    """
    answered = as_plans(plans)
    if actor is not None and (own := plans_of(actor)) is not None and (other := answered.differences(own)):
        raise ValueError(f"plans differ from the actor's plans for {', '.join(other)}; pass the actor's plans")
    failed = _failed(rollouts, answered)
    if not failed:
        return []
    names = sorted({task for task, _, _ in failed})
    own_suite = find_suite(names, suite)
    table = (own_suite.skills or load_skills()) if skills is None else skills
    all_trusted = {} if reference is None else as_plans(reference, "reference")
    trusted = {task: plan for task, plan in all_trusted.items() if task in names}
    seen = [states_of(task, k, steps, answered, _answers(steps, actor)) for task, k, steps in failed]
    scripts, trusted_scripts = Scripts(answered, table), Scripts(Plans(trusted), table) if trusted else None
    explained = [(states, explain(states, scripts, trusted_scripts)) for states in seen]
    if actor is None:
        return [
            Failure(states.task, seed, states.episode, cause, None, *blames[cause], evidence=evidence)
            for states, (cause, blames, evidence) in explained
        ]
    tasks = {name: own_suite.tasks.get(name, answered[name].definition) for name in names}
    env_options = {"seed": seed, "suite": own_suite, "engine": engine, "num_threads": num_threads}
    env_options["max_steps"] = own_suite.max_steps if max_steps is None else max_steps
    rerun = Rerun(tasks, env_options, noise_scale, num_envs, device, progress)
    reruns = Reruns(actor, evaluator, scripts, Plans(trusted) if trusted else None, rerun, {s.which: s for s in seen})
    reruns.run()
    shares = reruns.shares()
    return [_by_reruns(*both, reruns, shares[both[0].task], seed) for both in explained]


def _failed(rollouts: Iterable[Any], plans: Plans) -> list[tuple[str, int, TensorDictBase]]:
    """Return the task, the episode index and the time steps of each failed episode."""
    by_id = {task_id(task): task for task in plans}
    failed: list[tuple[str, int, TensorDictBase]] = []
    seen: set[EpisodeId] = set()
    for place, rollout in enumerate(rollouts):
        name = f"rollouts[{place}]"
        steps, number = (rollout.steps, rollout.episode) if isinstance(rollout, FinishedEpisode) else (rollout, None)
        if not isinstance(steps, TensorDictBase) or steps.batch_dims != 1 or not len(steps):
            got = type(steps).__name__
            raise ValueError(f"{name} must be a finished episode, or a non-empty TensorDict of batch (T,), got {got}")
        needed = ["observation", "task_id", ("next", "success"), *(["episode"] if number is None else [])]
        if missing := [str(key) for key in needed if steps.get(key, None) is None]:
            raise missing_keys(steps.keys(True, True), *missing)
        tasks = steps.get("task_id").unique().tolist()
        if len(tasks) != 1 or tasks[0] not in by_id:
            raise ValueError(f"{name} must be of exactly one task in plans ({', '.join(plans)}), got task_id {tasks}")
        episodes = steps.get("episode").unique().tolist() if number is None else [number]
        if len(episodes) != 1:
            raise ValueError(f"{name} must hold one episode, got {len(episodes)} episodes; pass one rollout for each")
        which = by_id[tasks[0]], episodes[0]
        if which in seen:
            raise ValueError(f"{name} repeats episode {which[1]} of {which[0]!r}; pass each episode once")
        seen.add(which)
        if not steps.get(("next", "success")).any():
            failed.append((*which, steps))
    return failed


def _answers(steps: TensorDictBase, actor: Any) -> Tensor | None:
    """Return the answers (T, S) bool of a policy's evaluators, averaged over their logits; None without evaluator."""
    evaluators = own_evaluators(actor)
    if not evaluators or "qaf_logits" in steps.keys():
        return None
    keys = dict.fromkeys(key for evaluator in evaluators for key in evaluator.in_keys)
    if missing := ", ".join(str(key) for key in keys if steps.get(key, None) is None):
        needed = f"rollouts must hold {missing}, which the policy's evaluator reads, or the evaluator's qaf_logits"
        raise ValueError(f"{needed}; evaluate(..., attribute=True) records them")
    with torch.no_grad(), evaluating(actor):
        device = device_of(actor)
        logits = [each.logits(*(steps.get(key).to(device) for key in each.in_keys)) for each in evaluators]
    return torch.stack(logits).mean(0).cpu() > 0


def keys_to_attribute(actor: Any, env: EnvBase) -> list[NestedKey]:
    """Return the keys that attribution reads from each time step: the required ones, and the actor's input keys."""
    written = set(env.full_observation_spec.keys(True, True))
    keys = [key for key in getattr(actor, "in_keys", ()) if key in written]
    return ["observation", "task_id", "qaf", *keys, "skill_weights", "qaf_logits"]


def _by_reruns(
    seen: EpisodeStates, explanation: Explanation, reruns: Reruns, shares: Mapping[str, float], seed: int
) -> Failure:
    """Return the failure with the cause found by the re-runs, and the finding that shows it."""
    which, known = seen.which, {"shares": dict(shares)}
    number = float(sum(task == seen.task for task, _ in reruns.seen))
    record: dict[str, Any] = known | {"evidence": {**explanation.evidence, "failed": number}}
    differs, again = reruns.differs.get(which), reruns.plain[which].first_success
    if reruns.fails_elsewhere(which) or (differs is not None and shares["nothing"] >= MARGIN):
        first = differs or Difference("nothing", len(seen.steps) - 1)
        cause: Cause = "environment differs" if reruns.environment_differs(which) else "not reproducible"
        return Failure(seen.task, seed, seen.episode, cause, None, None, first.at, first, succeeds_at=again, **record)
    record["counterfactuals"] = tried = {
        name: results[which] is not None for name, results in reruns.results.items() if which in results
    }
    # If both plans request the same actions, a success with the reference is not due to the reference's content.
    same = explanation.evidence.get("plan_departs") == 0.0
    mended = [name for name, success in tried.items() if success and not (same and name == "plan")]
    cause, also, by = decide(mended, shares)
    step, motion = reruns.step.get(which), None
    # Changed actions are a fact, so they are to blame even if the episode also fails without the change.
    found = _wrong_motion(reruns, which, "decided", by), _wrong_motion(reruns, which, "commanded", by)
    measured = [each for each in found if each[1] is not None]
    if measured and by not in ("environment", "perception", "query"):
        cause, motion, step = max(measured, key=lambda each: each[1].error if each[1] else 0.0)
        by, also = "wrapper" if by == "wrapper" else None, None
    elif by in ("gripper", "actuation"):
        motion = _wrong_motion(reruns, which, "scripted", by)[1]
    elif cause == "undecided" and explanation.cause == "query" and "query" not in tried:
        cause = "query"  # wrong answers are a fact, even if they could not be replaced
    elif cause == "undecided" and which in reruns.misled and reruns.misled[which].error > _SEEN:
        cause = "perception"
    if (episode := reruns.mended(by, which)) is not None:
        record |= {"replaced": by, "succeeds_at": len(episode.steps), "mended": episode}
    finding: Finding | None
    place, at, finding = explanation.blames.get(cause, explanation.blames["undecided"])
    if cause == "skill" and also is None and step is not None:
        plan = reruns.scripts.plans[seen.task]
        place, at, finding = step, stall_step(seen, step, plan.definition.layout), seen.active_time(plan, step)
    elif cause == "perception":
        finding = reruns.misled[which]
    elif cause == "undecided" and explanation.cause != "undecided":
        record["suspect"], finding = explanation.cause, explanation.blames[explanation.cause].finding
    elif motion is not None:
        finding = motion
    planless = plans_of(reruns.actor) is None and cause != "query"
    finding = finding if not planless or isinstance(finding, Misled | WrongMotion) else None
    return Failure(seen.task, seed, seen.episode, cause, also, None if planless else place, at, finding, **record)


def _wrong_motion(
    reruns: Reruns, which: EpisodeId, right: Literal["decided", "commanded", "scripted"], by: str | None = None
) -> tuple[Cause, WrongMotion | None, int | None]:
    """Return the part of the action that differs from the right action, the finding, and its plan step if only one."""
    compared = {"decided": reruns.wrapped, "commanded": reruns.executed, "scripted": reruns.scripted}[right]
    if (motion := compared.get(which)) is None:
        return "undecided", None, None
    gripper = gripper_of(reruns.scripts.plans)
    hand, fingers = motion.of(~gripper), motion.of(gripper)
    part = fingers if by == "gripper" or (by != "actuation" and fingers.error() > 4 * hand.error()) else hand
    if part.error() < (0.0 if by == "wrapper" or right == "scripted" else _CLEAR):
        return "undecided", None, None
    in_all, worst, shape = part.extent(exact=right != "scripted")
    errors = part.errors()
    steps = sum(error > 0.1 * max(errors.values()) for error in errors.values())
    name: Literal["gripper", "motion"] = "gripper" if part is fingers else "motion"
    finding = WrongMotion(name, right, shape, part.error(), steps)
    if part is fingers:
        return "gripper", finding, None
    return ("skill", finding, worst) if in_all is False else ("actuation", finding, None)


def decide(mended: Collection[str], shares: Mapping[str, float]) -> tuple[Cause, Cause | None, str | None]:
    """Decide the cause of a failed episode from the replacements with which the episode succeeds (``mended``).

    ``shares`` is, for each replacement, the fraction of the task's failed episodes it was tried on that it fixes, and
    for "nothing" the fraction that a plain re-run fixes. Return a cause, a second cause, and the deciding replacement.

    Measured errors come first, if correcting them helps. Then comes the smallest part of the policy whose replacement
    by scripts helps: a skill in one plan step, the gripper or the motion (of these two, the one that fixes more).
    Scripts for the whole policy show that the plan is sound, but not which part is to blame. The plan comes next. A
    part counts only if it fixes clearly more of the task's failed episodes than a re-run with nothing replaced, and
    than a re-run without noise.
    """
    fixes = {name: shares.get(name, 1.0) for name in mended}
    if facts := [name for name in _FACTS if name in fixes]:
        best = max(facts, key=fixes.__getitem__)
        return REPLACEMENTS[best][0], None, best
    if best := next((name for name in _PARTS if name in fixes), ""):
        if best == "gripper" and "actuation" in fixes:
            best = max(("gripper", "actuation"), key=fixes.__getitem__)
            if abs(fixes["gripper"] - fixes["actuation"]) < MARGIN:
                return "policy", None, best
        if fixes[best] >= fixes.get("no noise", -1.0) + MARGIN:
            clear = fixes[best] >= shares.get("nothing", 0.0) + MARGIN
            return REPLACEMENTS[best][0] if clear else "policy", None, best
    for name in ("no noise", "time"):
        if name in fixes:
            return REPLACEMENTS[name][0], None, name
    pair = next((name for name in mended if len(REPLACEMENTS[name]) > 1), None)
    return ("undecided", None, None) if pair is None else (REPLACEMENTS[pair][0], REPLACEMENTS[pair][1], pair)
