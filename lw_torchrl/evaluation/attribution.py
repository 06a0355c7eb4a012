"""attribute_failures: why episodes failed, by running them again with one part of what acted replaced."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase

from lw_torchrl._checks import Count, Scale, checked, missing_keys
from lw_torchrl._devices import device_of
from lw_torchrl.envs.episodes import FinishedEpisode
from lw_torchrl.evaluation.counterfactuals import Counterfactuals, own_evaluators
from lw_torchrl.evaluation.deciding import MARGIN, PAIR_WORDS, REPLACEMENTS, Decision, decide
from lw_torchrl.evaluation.explanation import EpisodeStates, Explanation, Scripts, explain, stall_step, states_of
from lw_torchrl.evaluation.failure_records import Failure
from lw_torchrl.evaluation.repeating import EpisodeId, EpisodeRepeater, NullControl, null_control
from lw_torchrl.language.plans import AnyPlans, Plans, as_plans
from lw_torchrl.language.skills import ScriptedSkill, load_skills
from lw_torchrl.language.tasks import task_id
from lw_torchrl.modules.networks import evaluating
from lw_torchrl.modules.policy import plans_of
from lw_torchrl.suites.suite import Suite, find_suite


@checked
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
    """Say of each failed episode what is to blame: what the policy was shown, the answers, the plan, a skill, another
    part of what it does, or the time; or that it does not fail again.

    **A rule explains.** *Query*, if the policy acted on other answers than the query answering function gives in the
    same states; else *plan*, if late in the episode the plan's true step asks for something else than the reference
    plan's, which is no proof: another plan that succeeds may; else *skill*. Without a reference the rule is weak: it
    tells wrong answers, a plan of which no condition holds, and a skill that stays far from where it goes; the rest is
    undecided. Without ``actor`` that is all.

    **A counterfactual decides**, with ``actor``. First the null control: the very same episode, its noise too, is run
    again with nothing replaced. If it succeeds it is *not reproducible*, and ``why`` says what differs. Else it is run
    with one part replaced by a sound one: the observations, if the policy was shown others than the environment told
    (*perception*); the answers, where they were wrong (*query*); the *plan*, by the reference; what scripted skills do
    (where a text is no scripted skill, the expert's actions) in one step of the plan (*skill*), for the *gripper* or
    the hand's motion (*actuation*) alone, or in all steps (*policy*, not told which part); twice the time (*out of
    time*). Where none mends, pairs are tried, which give ``cause`` and ``also``. Where several do, that counts which
    mends most of the task's failed episodes, and of those as good the smallest; a skill, unless what is wrong in its
    step is as wrong in the others. One mended episode may be luck: ``evidence`` and ``why`` hold how much of the task's
    failed episodes each mended, nothing replaced among them. A policy without plans is told of no step.

    Args:
        rollouts: episodes as :func:`evaluate` gives them to ``on_episode``, or TensorDicts of batch (T,), each one
            episode from its first state on; those with success are left out. Keys: ``observation`` (T, 39) float32,
            ``task_id`` (T,) int64, ``("next", "success")`` (T, 1) bool; of a TensorDict ``episode`` (T,) int64.
            Optional: the answers that the policy acted on, ``qaf_logits`` (T, S) float32, else ``qaf`` (T, S) bool;
            ``skill_weights`` (T, S) float32, for the step in force.
        plans: the plans that were carried out.
        actor: what acted: anything with ``plans`` and ``with_plans`` that writes ``action`` and ``skill_weights``. One
            that draws its actions cannot be run again alike; its counterfactuals tell less.
        reference: other plans, for some of the tasks, which are trusted.
        evaluator: what answered in the query answering function's place, between it and the actor: a
            :class:`QueryEvaluator`, or a module, function or :class:`torchrl.envs.Transform` that writes ``qaf``. An
            evaluator inside the policy is found there.
        skills: the scripted skills by text that are trusted; None for the suite's, :func:`load_skills` of
            Meta-World.
        seed, noise_scale, max_steps, suite, engine: with which the episodes were run. One that was cut before
            ``max_steps`` is run on: if it then succeeds, it is not reproducible.
        num_envs, num_threads, device, progress: as for :func:`evaluate`.

    Returns:
        A :class:`Failure` for each failed episode, in the order of the rollouts.

    Raises:
        ValueError: a rollout lacks a key, the same episode twice, a task without a plan, plans that are not the
            actor's, or an episode that does not begin as (task, seed, episode) does.

    Warns:
        UserWarning: the policy cannot carry out the reference; no plan is replaced.

    Example:
        A wrong offset, planted in the skill that reaches:

        >>> import lw_torchrl as lw
        >>> from dataclasses import replace
        >>> plans = lw.Plans({"reach": lw.load_plans("MT10")["reach"]})
        >>> skills, text = lw.load_skills(), plans["reach"].steps[1].skill
        >>> spoilt = {**skills, text: replace(skills[text], offset=(0.1, 0.0, 0.0))}
        >>> actor, episodes = lw.ScriptedSkillActor(plans, skills=spoilt), []
        >>> run, keys = {"seed": 1_000, "max_steps": 100}, ["observation", "task_id", "qaf", "skill_weights"]
        >>> told = {"also_record": keys, "on_episode": episodes.append}
        >>> _ = lw.evaluate(actor, tasks="reach", episodes_per_task=1, **run, **told)
        >>> [failure] = attribute_failures(episodes, plans, actor=actor, **run)
        >>> failure.cause, failure.counterfactuals
        ('skill', {'skill': True})

    Source: the plan's conditions, its steps and what carries them out are apart, so each can be replaced.
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
    found = find_suite(names, suite)
    table = (found.skills or load_skills()) if skills is None else skills
    given = {} if reference is None else as_plans(reference, "reference")
    others = {task: plan for task, plan in given.items() if task in names}
    seen = [states_of(task, k, steps, answered, _answers(steps, actor)) for task, k, steps in failed]
    scripts, theirs = Scripts(answered, table), Scripts(Plans(others), table) if others else None
    told = {one.which: explain(one, scripts, theirs) for one in seen}
    if actor is None:
        failures = []
        for one in seen:
            cause, blames, evidence = told[one.which]
            step, at, why = blames[cause]
            why = _text(*(["The states alone do not tell"] if cause == "undecided" else []), why)
            failures.append(Failure(one.task, seed, one.episode, cause, None, step, at, why, evidence))
        return failures
    tasks = {name: found.tasks.get(name, answered[name].definition) for name in names}
    max_steps = found.max_steps if max_steps is None else max_steps
    env = {"seed": seed, "suite": found, "engine": engine, "num_threads": num_threads}
    repeat = EpisodeRepeater(tasks, env, noise_scale, max_steps, num_envs, device, progress)
    null = null_control(repeat, {one.which: one.steps for one in seen}, actor, answered, evaluator)
    tried = Counterfactuals(actor, evaluator, None if theirs is None else theirs.plans, scripts, repeat, null)
    tried.run(seen, [which for which, one in told.items() if one.evidence.get("plan_departs") == 0.0])
    shares = tried.shares()
    return [_by_counterfactuals(one, told[one.which], tried, shares.get(one.task, {}), seed) for one in seen]


def _failed(rollouts: Iterable[Any], plans: Plans) -> list[tuple[str, int, TensorDictBase]]:
    """The failed episodes: task, episode and steps."""
    by_id = {task_id(task): task for task in plans}
    found: list[tuple[str, int, TensorDictBase]] = []
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
            found.append((*which, steps))
    return found


def _answers(steps: TensorDictBase, actor: Any) -> Tensor | None:
    """What the evaluators inside a policy answer in these states, the mean of several; None of one without."""
    evaluators = own_evaluators(actor)
    if not evaluators or "qaf_logits" in steps.keys():
        return None
    read = dict.fromkeys(key for one in evaluators for key in one.in_keys)
    if missing := [str(key) for key in read if steps.get(key, None) is None]:
        raise ValueError(
            f"rollouts must hold {', '.join(missing)}, which the policy's evaluator reads, or its answers, qaf_logits; "
            "evaluate(..., attribute=True) records them"
        )
    with torch.no_grad(), evaluating(actor):
        device = device_of(actor)
        logits = [one.logits(*(steps.get(key).to(device) for key in one.in_keys)) for one in evaluators]
    return torch.stack(logits).mean(0).cpu() > 0


def keys_to_attribute(actor: Any, env: EnvBase) -> list[NestedKey]:
    """What to record of each step, of what is there, for failures to be attributed."""
    there = env.full_observation_spec.keys(True, True)
    keys: list[NestedKey] = ["observation", "task_id", *(["qaf"] if "qaf" in there else [])]
    keys += [key for key in getattr(actor, "in_keys", ()) if key in there]
    keys += [key for key in ("skill_weights", "qaf_logits") if key in getattr(actor, "out_keys", ())]
    return list(dict.fromkeys(keys))


def _by_counterfactuals(
    one: EpisodeStates, told: Explanation, tried: Counterfactuals, shares: Mapping[str, float], seed: int
) -> Failure:
    """What the counterfactuals tell, explained by the states."""
    which, null = one.which, tried.null
    share = null.share(one.task)
    by = {f"mended_by_{name.replace(' + ', '_and_')}": of for name, of in {"nothing": share, **shares}.items()}
    evidence = {**told.evidence, "failed": float(sum(task == one.task for task, _ in null.episodes)), **by}
    if null.succeeds(which) or (which in null.differs and share >= MARGIN):
        return _not_reproducible(one, null, evidence, seed)
    first = {name: results[which] for name, results in tried.found.items() if which in results}
    mended = [name for name, hit in first.items() if hit is not None]
    same = told.evidence.get("plan_departs") == 0.0
    counting = [name for name in tried.mending(one) if not (same and name == "plan")]
    decision = decide(counting, shares, share)
    cause, also, how = decision.cause, decision.also, tried.mended(decision, which)
    only = tried.step_of_motion(one) if cause == "actuation" else None
    cause = cause if only is None else "skill"
    if also is not None:
        words = f"Neither {PAIR_WORDS[cause]} nor {PAIR_WORDS[also]} alone mend it, both together do"
    elif how is not None:
        words = f"With {how.by} the same episode succeeds, at t = {len(how.steps)}"
        words += _certainty(decision, shares, share)
        words += "" if only is None else f". What is wrong in it is wrong in step {only + 1} alone"
        if cause == "actuation" and "skill" in set(mended) - set(counting):
            alone = f"A scripted skill in step {tried.step[which] + 1} alone suffices"
            words += f". {alone} too, but what is wrong there is as wrong in other steps"
    elif same and "plan" in mended:
        words = "With the reference plan it succeeds, though in no state that asks for anything else"
    elif told.cause == "query" and "query" not in first:
        cause, words = "query", "These answers could not be replaced"
    elif first:
        words = f"It fails as well with {_listed(first, 'or with')}"
    else:
        words = "There is nothing to replace"
    if cause == "undecided" and told.cause != "undecided":
        words += f". By the states alone it would be the {told.cause}: {told.blames[told.cause].why}"
    step, at, why = told.blames.get(cause, told.blames["undecided"])
    if cause == "skill" and also is None:
        step, plan = tried.step[which] if only is None else only, tried.plans[one.task]
        at, why = stall_step(one, step, plan.definition.layout), one.active_time(plan, step)
    elif cause == "perception":
        why = null.misled[which].words
    if plans_of(tried.actor) is None and cause != "query":
        step = None
    told_why = [] if step is None and cause != "perception" else [why]
    replaced = {name: name in mended for name in first}
    return Failure(one.task, seed, one.episode, cause, also, step, at, _text(*told_why, words), evidence, replaced, how)


def _not_reproducible(one: EpisodeStates, null: NullControl, evidence: Mapping[str, float], seed: int) -> Failure:
    """Of an episode that nothing has to be replaced in, or that cannot be run again in a task of such."""
    succeeds = null.succeeds(one.which)
    again = "it succeeds" if succeeds else "it fails in another way, and others of the task succeed"
    at, what = null.differs.get(one.which, (len(one.steps) - 1, "nothing that was recorded"))
    why = _text(f"Run again with nothing replaced {again}", f"What differs is {what}")
    return Failure(one.task, seed, one.episode, "not reproducible", None, None, at, why, evidence)


def _certainty(decision: Decision, shares: Mapping[str, float], null: float) -> str:
    """How sure a cause is: what it mends of the task's failed episodes, beside the next best and nothing replaced."""
    assert decision.by is not None
    parts = [f"; it mends {shares.get(decision.by, 1.0):.0%} of the task's failed episodes"]
    if decision.rival is not None:
        parts.append(f"{REPLACEMENTS[decision.rival].words} {shares.get(decision.rival, 1.0):.0%}")
    return ", ".join([*parts, f"nothing replaced {null:.0%}"])


def _listed(names: Iterable[str], joint: str) -> str:
    pairs = {f"{a} + {b}": f"{PAIR_WORDS[a]} and {PAIR_WORDS[b]}" for a in PAIR_WORDS for b in PAIR_WORDS}
    words = [pairs.get(name) or REPLACEMENTS[name].words for name in names]
    return f" {joint} ".join(words) if len(words) < 3 else f"{', '.join(words[:-1])} {joint} {words[-1]}"


def _text(*sentences: str) -> str:
    return " ".join(f"{one[0].upper()}{one[1:]}." for one in sentences)
