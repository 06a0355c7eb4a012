"""attribute_failures: find out why episodes failed by re-running them with one part of the policy replaced."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase

from lw_torchrl._util.checks import Count, Scale, missing_keys, typed
from lw_torchrl._util.devices import device_of
from lw_torchrl.envs.episodes import FinishedEpisode
from lw_torchrl.evaluation.diagnose.counterfactuals import Counterfactuals, Rerun, null_control
from lw_torchrl.evaluation.diagnose.failure import REPLACEMENTS, Cause, Difference, Failure, Finding
from lw_torchrl.evaluation.diagnose.replacements import EpisodeId, Scripts, own_evaluators
from lw_torchrl.evaluation.diagnose.states import EpisodeStates, Explanation, explain, stall_step, states_of
from lw_torchrl.language.plans import AnyPlans, Plans, as_plans
from lw_torchrl.language.skills import ScriptedSkill, load_skills
from lw_torchrl.language.tasks import task_id
from lw_torchrl.modules.parts import evaluating
from lw_torchrl.modules.policy import plans_of
from lw_torchrl.suites.suite import Suite, find_suite

MARGIN = 0.3  # a clear lead of one replacement, as a fraction of the task's failed episodes
_FACTS = ("perception", "query")  # tried only after a wrong observation or answer was recorded, which is a fact
_WIDER = {"skill": ("gripper", "actuation", "policy"), "gripper": ("policy",), "actuation": ("policy",)}
"""Replacements that contain another replacement, so that they fix every episode that the contained one fixes."""


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
    """Find the cause of each failed episode: the observations, the answers to the plan's conditions, the plan, a skill,
    another part of the policy, or the time limit.

    **A rule examines the states.** The cause is *query* if the policy acted on wrong answers; otherwise *plan* if, late
    in the episode, plan and reference plan request different actions; otherwise *skill*. The rule is not a proof: a
    plan that differs from the reference may succeed. Without a reference, the rule detects only wrong answers, a plan
    without a true condition, and a skill that stays far from its target. Without ``actor``, only the rule is used.

    **Counterfactual re-runs decide**, if ``actor`` is given. First comes the null control: the episode is re-run with
    the same noise and nothing replaced. If the re-run succeeds, the failure is *not reproducible*, and the finding
    reports what differs. Otherwise the episode is re-run with one part replaced by a trusted one:

    - *perception*: the true observations, if the policy received wrong observations;
    - *query*: the true answers, if the policy acted on wrong answers;
    - *plan*: the reference plan;
    - *skill*: in one plan step, the action of a scripted skill (of the expert if the plan step has no scripted skill);
      *gripper* and *actuation*: in all plan steps, only the gripper's or the hand's part of the action; *policy*: in
      all plan steps, the whole action;
    - *out of time*: twice the time limit.

    If no replacement helps, pairs are tried, which give ``cause`` and ``also``. If several replacements help, the one
    that fixes most of the task's failed episodes counts; among about equally good ones, the smallest. A skill does not
    count if other plan steps have the same fault. For a policy without plans, no plan step is reported.

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
        ValueError: a rollout lacks a key, an episode occurs twice, a task has no plan, the plans differ from the
            actor's plans, or an episode does not start from the initial state of (task, seed, episode).

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
    null = null_control(rerun, {states.which: states.steps for states in seen}, actor, answered, evaluator)
    tried = Counterfactuals(
        actor, evaluator, None if trusted_scripts is None else trusted_scripts.plans, scripts, rerun, null
    )
    tried.run(seen, [states.which for states, explanation in explained if _plans_agree(explanation)])
    shares = tried.shares()
    return [_by_counterfactuals(*both, tried, shares.get(both[0].task, {}), seed) for both in explained]


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


def _plans_agree(explanation: Explanation) -> bool:
    """Return whether the plan and the reference request the same actions in all states of an episode."""
    return explanation.evidence.get("plan_departs") == 0.0


def _by_counterfactuals(
    seen: EpisodeStates, explanation: Explanation, tried: Counterfactuals, shares: Mapping[str, float], seed: int
) -> Failure:
    """Return the failure with two additions: the cause found by the counterfactual re-runs and the finding from the
    states.
    """
    which, null = seen.which, tried.null
    share, number = null.share(seen.task), float(sum(task == seen.task for task, _ in null.episodes))
    record: dict[str, Any] = {"evidence": {**explanation.evidence, "failed": number}}
    record["shares"] = {"nothing": share, **shares}
    if null.succeeds(which) or (which in null.differs and share >= MARGIN):
        first = null.differs.get(which, Difference("nothing", len(seen.steps) - 1))
        record["succeeds_at"] = null.episodes[which].first_success
        return Failure(seen.task, seed, seen.episode, "not reproducible", None, None, first.at, first, **record)
    tried_here = {name: results[which] is not None for name, results in tried.results.items() if which in results}
    record["counterfactuals"] = tried_here
    # If both plans request the same actions, a success with the reference is not due to the reference's content.
    same = _plans_agree(explanation)
    counting = [name for name in tried.mending(seen) if not (same and name == "plan")]
    decision = decide(counting, shares, share)
    cause, also, mended = decision.cause, decision.also, tried.mended(decision.by, which)
    # If the motion is wrong only in one step, the skill of that step is to blame.
    only = tried.step_of_motion(seen) if cause == "actuation" else None
    cause = cause if only is None else "skill"
    if mended is not None:
        record |= {"replaced": decision.by, "rival": decision.rival, "succeeds_at": len(mended.steps), "mended": mended}
        if cause == "actuation" and tried_here.get("skill") and "skill" not in counting:
            record["scripted_step"] = tried.step[which]
    elif explanation.cause == "query" and "query" not in tried_here and not (same and tried_here.get("plan")):
        cause = "query"  # wrong answers are a fact, even if they could not be replaced
    step: int | None
    finding: Finding | None
    step, at, finding = explanation.blames.get(cause, explanation.blames["undecided"])
    if cause == "skill" and also is None:
        step, plan = tried.step[which] if only is None else only, tried.plans[seen.task]
        at, finding = stall_step(seen, step, plan.definition.layout), seen.active_time(plan, step)
    elif cause == "perception":
        finding = null.misled[which]
    elif cause == "undecided" and explanation.cause != "undecided":
        record["suspect"], finding = explanation.cause, explanation.blames[explanation.cause].finding
    if plans_of(tried.actor) is None and cause != "query":
        step = None
    finding = None if step is None and cause != "perception" else finding
    return Failure(seen.task, seed, seen.episode, cause, also, step, at, finding, **record)


class Decision(NamedTuple):
    """A failure's cause, a second cause, the deciding replacement (``by``), and the next best one (``rival``)."""

    cause: Cause
    also: Cause | None = None
    by: str | None = None
    rival: str | None = None


def decide(mended: Collection[str], shares: Mapping[str, float], null: float = 0.0) -> Decision:
    """Decide the cause of a failed episode from the replacements with which the episode succeeds (``mended``).

    ``shares`` is, for each replacement, the fraction of the task's failed episodes it was tried on that it fixes;
    ``null`` is that fraction for a plain re-run.

    Wrong observations and answers come first, if correcting them helps. Among the other replacements, the one that
    fixes most of the task's failed episodes counts. Among about equally good ones, the first in this order counts: the
    plan, unless scripts that follow the plan succeed; a skill in one plan step; the gripper or the motion. The cause is
    the policy as a whole if two replacements that do not contain each other are about equally good, or if none is
    clearly better than a plain re-run. The time limit comes last, then pairs.
    """
    single = {name: causes[0] for name, causes in REPLACEMENTS.items() if len(causes) == 1}
    fixes = {name: shares.get(name, 1.0) for name in single if name in mended}
    time = fixes.pop("time", None)
    if not fixes:
        if time is not None:
            return Decision("out of time", by="time")
        pair = choose_pair(mended, shares)
        return Decision("undecided") if pair is None else Decision(*pair)
    if "policy" in fixes and any(name in fixes for name in ("skill", "gripper", "actuation")):
        fixes.pop("plan", None)  # the plan is sound, because scripts that follow it succeed
    best = next(iter(fixes))
    if facts := [name for name in fixes if name in _FACTS]:
        best = max(facts, key=fixes.__getitem__)
    else:
        for name, share in fixes.items():
            if share >= fixes[best] + MARGIN:
                best = name
    rivals = {name: share for name, share in fixes.items() if name != best and name not in _WIDER.get(best, ())}
    rival = max(rivals, key=rivals.__getitem__, default=None)
    close = rival is not None and best not in _FACTS and best != "plan" and rivals[rival] > fixes[best] - MARGIN
    if fixes[best] < null + MARGIN or (close and best != "policy"):
        return Decision("policy", by=best, rival=rival)
    return Decision(single[best], by=best, rival=rival)


def choose_pair(mended: Iterable[str], shares: Mapping[str, float]) -> tuple[Cause, Cause, str] | None:
    """Return the pair of causes that counts, and the replacement that fixes both; None if no pair helps.

    Wrong answers come first, then the cause whose replacement fixes more episodes on its own.
    """
    alone = {**shares, "skill": max(shares.get("skill", 0.0), shares.get("policy", 0.0))}
    pairs = [name for name in mended if len(REPLACEMENTS[name]) > 1]
    if not pairs:
        return None
    by = max(pairs, key=lambda name: sum(alone.get(cause, 0.0) for cause in REPLACEMENTS[name]))
    cause, also = REPLACEMENTS[by]
    if cause != "query" and alone.get(also, 0.0) > alone.get(cause, 0.0):
        cause, also = also, cause
    return cause, also, by
