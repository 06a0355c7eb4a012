"""attribute_failures: find out why episodes failed by re-running them with one part of the policy replaced."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from lw_torchrl._util.checks import Count, Scale, missing_keys, typed
from lw_torchrl._util.text import counted
from lw_torchrl.envs.episodes import FinishedEpisode
from lw_torchrl.evaluation.diagnose.failure import REPLACEMENTS, Cause, Failure, Finding
from lw_torchrl.evaluation.diagnose.replacements import EpisodeId, Scripts
from lw_torchrl.evaluation.diagnose.reruns import Reruns, Settings, shares_of
from lw_torchrl.evaluation.diagnose.states import (
    OFTEN_WRONG,
    WRONG,
    Blame,
    Departures,
    FailedEpisode,
    blame_answers,
    blame_plan,
    blame_step,
    departures,
    last_active_step,
)
from lw_torchrl.evaluation.rollout import actor_plans
from lw_torchrl.language.canonical import explain_canonical, fallback_plan
from lw_torchrl.language.plans import AnyPlans, Plans, as_plans
from lw_torchrl.language.skills import ScriptedSkill, load_skills
from lw_torchrl.language.tasks import TASKS, task_id
from lw_torchrl.modules.policy import plans_of
from lw_torchrl.suites.suite import Suite, find_suite

MARGIN = 0.3  # lead that makes a replacement decisive, as a fraction of the task's failed episodes
# These are tried only if a measured observation, answer or action is wrong, or if the engine is a function.
_FACTS = ("environment", "perception", "query", "wrapper")
_PARTS = ("skill", "gripper", "actuation", "policy", "plan")  # in order of precedence
_SEEN = 0.01  # larger errors of an observation, in metres, count as a cause even if correcting them does not help
_CLEAR = 0.1  # smaller changes of the policy's action (root mean square), by wrapper or environment, are not a cause


@typed
def attribute_failures(
    rollouts: Iterable[FinishedEpisode | TensorDictBase],
    plans: AnyPlans,
    *,
    actor: Callable[[TensorDictBase], TensorDictBase],
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

    **Measurements come first**. Each episode is re-run with the same noise and nothing replaced. Differences from the
    rollout, and errors in the observations, answers and executed actions, show the causes *environment differs*, *not
    reproducible*, *perception*, *query*, *actuation* and *gripper*.

    **Replacements decide the remaining cases**. The episode is re-run without noise, with scripts instead of the policy
    or a part of it, with the reference plan, with twice the time, and with two parts replaced, which are reported as
    ``cause`` and ``also``. docs/why-did-it-fail.md lists each measurement and replacement with its cause.

    Args:
        rollouts: episodes as :func:`evaluate` passes them to ``on_episode``, or TensorDicts of batch (T,), each with
            one whole episode; successful episodes are skipped. Keys: ``observation`` (T, 39) float32, ``task_id`` (T,)
            int64, ``("next", "success")`` (T, 1) bool, and, in a TensorDict, ``episode`` (T,) int64. Optional:
            ``("next", "executed_action")`` or, if that is absent, ``action`` (T, 4) float32.
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
        >>> run = {"seed": 1_000, "max_steps": 100}
        >>> record = {"also_record": ["observation", "task_id"], "on_episode": episodes.append}
        >>> _ = lw.evaluate(actor, tasks="reach", episodes_per_task=1, **run, **record)
        >>> [failure] = attribute_failures(episodes, plans, actor=actor, **run)
        >>> failure.cause, failure.counterfactuals
        ('skill', {'no noise': False, 'policy': True, 'skill': True})

    Source: a plan's conditions, skills and skill execution are separate in the policy, so each can be replaced.
    """
    answered = as_plans(plans)
    actor_plans(actor, answered)  # raises an error if the plans differ from the actor's
    failed = _failed(rollouts, answered)
    if not failed:
        return []
    names = sorted({task for task, _ in failed})
    own_suite = find_suite(names, suite)
    scripts = Scripts(answered, (own_suite.skills or load_skills()) if skills is None else skills)
    trusted = None if reference is None else as_plans(reference, "reference")
    tasks = {name: own_suite.tasks.get(name, answered[name].definition) for name in names}
    env_options = {"seed": seed, "suite": own_suite, "num_threads": num_threads}
    settings = Settings(actor, evaluator, scripts, noise_scale, engine, max_steps or own_suite.max_steps)
    reruns = Reruns(settings, trusted, tasks, env_options, num_envs, device, progress)
    cases = reruns.run(failed)
    shares = {task: shares_of([case for case in cases if case.task == task]) for task in names}
    return [_verdict(case, reruns, shares[case.task], seed, len(failed[case.which])) for case in cases]


def _failed(rollouts: Iterable[Any], plans: Plans) -> dict[EpisodeId, TensorDictBase]:
    """Return the time steps of each failed episode."""
    by_id = {task_id(task): task for task in plans}
    episodes: dict[EpisodeId, TensorDictBase] = {}
    for place, rollout in enumerate(rollouts):
        name = f"rollouts[{place}]"
        steps, number = (rollout.steps, rollout.episode) if isinstance(rollout, FinishedEpisode) else (rollout, None)
        if not isinstance(steps, TensorDictBase) or steps.batch_dims != 1 or not len(steps):
            got = type(steps).__name__
            raise ValueError(f"{name} must be a finished episode, or a TensorDict of batch (T,), got {got}")
        needed = ["observation", "task_id", ("next", "success"), *(["episode"] if number is None else [])]
        if missing := [str(key) for key in needed if steps.get(key, None) is None]:
            raise missing_keys(steps.keys(True, True), *missing)
        tasks = steps.get("task_id").unique().tolist()
        numbers = steps.get("episode").unique().tolist() if number is None else [number]
        if len(tasks) != 1 or tasks[0] not in by_id or len(numbers) != 1:
            got = f"got task_id {tasks} and {counted(len(numbers), 'episode')}"
            raise ValueError(f"{name} must hold one episode of one of the tasks {', '.join(plans)}, {got}")
        which = by_id[tasks[0]], numbers[0]
        if which in episodes:
            raise ValueError(f"{name} repeats episode {which[1]} of {which[0]!r}; pass each episode once")
        episodes[which] = steps
    return {which: steps for which, steps in episodes.items() if not steps.get(("next", "success")).any()}


def _verdict(case: FailedEpisode, reruns: Reruns, shares: Mapping[str, float], seed: int, length: int) -> Failure:
    """Return the failure of an episode, with the cause that the re-runs show and the finding that supports it."""
    record: dict[str, Any] = {"task": case.task, "seed": seed, "episode": case.plain.episode, "shares": dict(shares)}
    if case.fails_elsewhere or (case.differs is not None and shares["nothing"] >= MARGIN):
        at = length - 1 if case.differs is None else int(case.differs.values["at"])
        record["cause"] = "environment differs" if case.environment_differs else "not reproducible"
        record |= {"also": None, "step": None, "finding": case.differs}
        return Failure(**record, at=at, succeeds_at=case.plain.first_success)
    scripts, trusted, compared = reruns.settings.scripts, reruns.trusted, None
    if trusted is not None and case.task in trusted.scripts.plans:
        compared = departures(case, scripts, trusted.scripts)
    record["evidence"] = evidence = _evidence(case, scripts, compared)
    record["counterfactuals"] = tried = {name: episode is not None for name, episode in case.results.items()}
    # If both plans request the same actions, a success with the reference is not due to the reference's content.
    same = evidence.get("plan_departs") == 0.0
    cause, also, by = decide([name for name in tried if case.is_fixed(name) and not (same and name == "plan")], shares)
    step, motion, gripper = case.step, None, reruns.gripper
    # A measured change of the actions is the cause even if the episode also fails without the change.
    changes = [_wrong_motion(case, name, gripper, by) for name in ("wrapped action", "executed action")]
    if any(changes) and not (by or "").startswith(("environment", "perception", "query")):
        cause, motion, step = max(filter(None, changes), key=lambda change: float(change[1].values["error"]))
        by, also = "wrapper" if by == "wrapper" else None, None
    elif by in ("gripper", "actuation") and (change := _wrong_motion(case, "policy's action", gripper, by)):
        motion = change[1]
    elif cause == "undecided" and case.answers_wrong >= (OFTEN_WRONG if "query" in tried else WRONG):
        cause = "query"  # the answers were measured to be wrong, even if replacing them was impossible or not enough
    elif cause == "undecided" and case.misled is not None and float(case.misled.values["error"]) > _SEEN:
        cause = "perception"
    if by is not None and (episode := case.results[by]) is not None:
        record |= {"replaced": by, "succeeds_at": len(episode.steps), "mended": episode}
    place, at, finding = _blame(case, cause, scripts, compared, step if also is None else None)
    at = min(at, length - 1)  # the rollout may be shorter than its re-run
    changed = case.misled if cause == "perception" else None if cause == "skill" else motion
    if plans_of(reruns.settings.actor) is None and cause != "query":
        return Failure(**record, cause=cause, also=also, step=None, at=at, finding=changed)
    return Failure(**record, cause=cause, also=also, step=place, at=at, finding=changed or finding)


def _blame(case: FailedEpisode, cause: Cause, scripts: Scripts, compared: Departures | None, step: int | None) -> Blame:
    """Return the plan step, the state and the finding that show a cause."""
    if cause == "query":
        return blame_answers(case)
    if cause == "plan" and compared is not None and compared.departs.any():
        return blame_plan(case, compared)
    stuck = blame_step(case, scripts, step if cause == "skill" and step is not None else last_active_step(case))
    return stuck._replace(at=len(case.active) - 1) if cause == "out of time" else stuck


def _evidence(case: FailedEpisode, scripts: Scripts, compared: Departures | None) -> dict[str, float]:
    """Return numbers by name: measurements in the states, and reasons why a success may not be due to the plan.

    "expert_steps" is the number of plan steps without a scripted skill, in which Meta-World's expert acts;
    "generic_plan" is 1 if the policy follows the generic plan; "not_understood" is 1 if no plan step could be parsed.
    """
    plan, unscripted = case.plan, scripts.skills[case.task].count(None)
    uncovered = (~case.truth.any(-1))[-case.late :]
    evidence = {"answers_wrong": case.answers_wrong, "no_condition_late": float(uncovered.float().mean())}
    if compared is not None:
        evidence["plan_departs"] = float(compared.departs.float().mean())
    if [s for s in plan.steps if not (s.role and s.role.fallback)] == list(fallback_plan(plan.definition).steps):
        evidence["generic_plan"] = 1.0
    if unscripted and case.task in TASKS:
        evidence["expert_steps"] = float(unscripted)
        if plan.steps[0].role is None and explain_canonical(plan).source == "fallback":
            evidence["not_understood"] = 1.0
    return evidence


def _wrong_motion(
    case: FailedEpisode, kind: str, gripper: Tensor, by: str | None
) -> tuple[Cause, Finding, int | None] | None:
    """Return the cause of a wrong gripper or hand motion, the finding, and the plan step (None for several)."""
    by_kind = {"wrapped action": case.wrapped, "executed action": case.executed, "policy's action": case.scripted}
    if (motion := by_kind[kind]) is None:
        return None
    hand, fingers = motion.of(~gripper), motion.of(gripper)
    part = fingers if by == "gripper" or (by != "actuation" and fingers.error() > 4 * hand.error()) else hand
    is_exact = kind != "policy's action"
    if is_exact and by != "wrapper" and part.error() < _CLEAR:
        return None
    in_all, worst, shape = part.extent(exact=is_exact)
    errors = part.errors().values()
    steps = sum(error > 0.1 * max(errors) for error in errors)
    name = "gripper's command" if part is fingers else "hand's motion"
    values: dict[str, Any] = {"part": name, "shape": shape, "error": part.error(), "steps": steps, "of": len(errors)}
    if part is fingers:
        return "gripper", Finding(kind, values), None
    return ("skill", Finding(kind, values), worst) if in_all is False else ("actuation", Finding(kind, values), None)


def decide(mended: Collection[str], shares: Mapping[str, float]) -> tuple[Cause, Cause | None, str | None]:
    """Decide the cause of a failed episode from the replacements with which the episode succeeds (``mended``).

    ``shares`` maps each replacement to the fraction of episodes that it fixes, among the task's failed episodes on
    which it was tried; "nothing" is the plain re-run. Return a cause, a second cause, and the deciding replacement.

    Measured errors come first, if correcting them helps. Then comes the smallest part of the policy whose replacement
    by scripts helps: a skill in one plan step, the gripper or the motion (of these two, the one that fixes more).
    Scripts for the whole policy show that the plan is sound, but not which part is to blame. The plan comes next. A
    part counts only if it fixes clearly more of the task's failed episodes than a re-run with nothing replaced, and
    than a re-run without noise.
    """
    fixes = {name: shares.get(name, 1.0) for name in mended}
    if facts := [name for name in _FACTS if name in fixes]:
        best = max(facts, key=fixes.__getitem__)
        return REPLACEMENTS[best]["causes"][0], None, best
    if best := next((name for name in _PARTS if name in fixes), ""):
        if best == "gripper" and "actuation" in fixes:
            best = max(("gripper", "actuation"), key=fixes.__getitem__)
            if abs(fixes["gripper"] - fixes["actuation"]) < MARGIN:
                return "policy", None, best
        if fixes[best] >= fixes.get("no noise", -1.0) + MARGIN:
            clear = fixes[best] >= shares.get("nothing", 0.0) + MARGIN
            return REPLACEMENTS[best]["causes"][0] if clear else "policy", None, best
    for name in ("no noise", "time"):
        if name in fixes:
            return REPLACEMENTS[name]["causes"][0], None, name
    pair = next((name for name in mended if " + " in name), None)
    cause, also = ("undecided", None) if pair is None else REPLACEMENTS[pair]["causes"]
    return cause, also, pair
