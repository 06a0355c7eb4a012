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
from lw_torchrl.evaluation.counterfactuals import Counterfactuals, EpisodeId, EpisodeRepeater, own_evaluators
from lw_torchrl.evaluation.explanation import EpisodeStates, Explanation, Scripts, explain, stall_step, states_of
from lw_torchrl.evaluation.failure_records import Cause, Failure
from lw_torchrl.language.plans import AnyPlans, Plans, as_plans
from lw_torchrl.language.skills import ScriptedSkill, load_skills
from lw_torchrl.language.tasks import task_id
from lw_torchrl.modules.networks import evaluating
from lw_torchrl.modules.policy import plans_of
from lw_torchrl.suites.suite import Suite, find_suite

_MARGIN = 0.3  # minimum lead for a larger replacement to win, as a share of the task's failed episodes
_COUNTERFACTUALS: dict[str, tuple[Cause, str]] = {  # the smaller ones first; time counts where nothing else mends
    "query": ("query", "true answers"),
    "skill": ("skill", "a script in one step"),
    "plan": ("plan", "the reference plan"),
    "skills": ("skill", "scripts in all steps"),
    "time": ("out of time", "twice the time"),
}
_PARTS: dict[str, str] = {"query": "true answers", "plan": "the reference plan", "skill": "scripts"}


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
    """Say of each failed episode whether a query was answered wrongly, the plan led astray, a skill was clumsy, or it
    only lacked time.

    **A rule explains.** *Query*, if the policy acted on other answers than the query answering function gives in the
    same states; else *plan*, if late in the episode the plan's true step asks for something else than the reference
    plan's, which is no proof: another plan that succeeds may; else *skill*. Without a reference the rule is weak: it
    tells wrong answers, a plan of which no condition holds, and a skill that stays far from where it goes; the rest is
    undecided. Without ``actor`` that is all.

    **A counterfactual decides**, with ``actor``: the very same episode, its noise too, is run again with true answers,
    where they were wrong; with scripted skills in one step of the plan, or, if that mends nothing, in all (where a text
    is no scripted skill, with the expert's actions); with the reference plan; with twice the time. What alone mends the
    episode is its cause. Where several do, the smallest replacement counts: answers, a skill in one step, the plan,
    skills in all steps, unless a larger one mends clearly more of the task's failed episodes; time counts last. Where
    none mends, pairs are tried, which give ``cause`` and ``also``. One mended episode may be luck: ``evidence`` holds
    how much of the task's failed episodes each mended.

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
        seed, noise_scale, max_steps, suite, engine: with which the episodes were run.
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
        >>> spoilt = {text: replace(skill, offset=(0.1, 0.0, 0.0)) for text, skill in lw.load_skills().items()}
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
    firsts = {one.which: one.steps.get("observation")[0] for one in seen}
    env = {"seed": seed, "suite": found, "engine": engine, "num_threads": num_threads}
    repeat = EpisodeRepeater(tasks, firsts, env, noise_scale, max_steps, num_envs, device, progress)
    tried = Counterfactuals(actor, evaluator, None if theirs is None else theirs.plans, scripts, repeat)
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
        logits = [one.answers(*(steps.get(key).to(device) for key in one.in_keys)) for one in evaluators]
    return torch.stack(logits).mean(0).cpu() > 0


def keys_to_attribute(actor: Any, env: EnvBase) -> list[NestedKey]:
    """What to record of each step, of what is there, for failures to be attributed."""
    there = env.full_observation_spec.keys(True, True)
    keys: list[NestedKey] = ["observation", "task_id", *(["qaf"] if "qaf" in there else [])]
    keys += [key for key in getattr(actor, "in_keys", ()) if key in there]
    keys += [key for key in ("skill_weights", "qaf_logits") if key in getattr(actor, "out_keys", ())]
    return list(dict.fromkeys(keys))


def choose_cause(mended: Iterable[str], shares: Mapping[str, float]) -> str | None:
    """Of the single replacements that mend an episode, the one that counts; None of none.

    It is the smallest, unless a larger one mends more of the task's failed episodes by 0.3 of them.
    More time comes last.
    """
    given = set(mended)
    best = None
    for name in _COUNTERFACTUALS:
        lead = best is None or (name != "time" and shares.get(name, 0.0) >= shares.get(best, 0.0) + _MARGIN)
        best = name if name in given and lead else best
    return best


def choose_cause_pair(mended: Iterable[str], shares: Mapping[str, float]) -> tuple[Cause, Cause] | None:
    """The pair that counts, the first the cause: wrong answers, which are a fact; else what alone mends more of the
    task's failed episodes."""
    alone = {**shares, "skill": max(shares.get("skill", 0.0), shares.get("skills", 0.0))}
    found: list[Any] = [name.split(" + ") for name in mended if " + " in name]
    if not found:
        return None
    cause, also = max(found, key=lambda pair: sum(alone.get(name, 0.0) for name in pair))
    return (also, cause) if cause != "query" and alone.get(also, 0.0) > alone.get(cause, 0.0) else (cause, also)


def _by_counterfactuals(
    one: EpisodeStates, told: Explanation, tried: Counterfactuals, shares: Mapping[str, float], seed: int
) -> Failure:
    """What the counterfactuals tell, explained by the states."""
    first = {name: results[one.which] for name, results in tried.found.items() if one.which in results}
    mended = {name: hit for name, hit in first.items() if hit is not None}
    replaced: dict[str, bool] = {}
    for name in first:
        part = "skill" if name == "skills" else name
        replaced[part] = replaced.get(part, False) or name in mended
    cause: Cause = "undecided"
    also: Cause | None = None
    decided: tuple[str, str] | None = None  # the counterfactual, and what it replaces, in words
    same = told.evidence.get("plan_departs") == 0.0
    best = choose_cause([name for name in mended if not (same and name == "plan")], shares)
    if best is not None:
        cause, part = _COUNTERFACTUALS[best]
        decided = best, part
        words = f"With {part} the same episode succeeds, at step {len(mended[best].steps) - 1}"
        if others := [name for name in mended if name in _COUNTERFACTUALS and name not in ("time", best)]:
            words += f"; with {_listed(others, 'and')} too, which replaces more or mends less of the task"
    elif (pair := choose_cause_pair(mended, shares)) is not None:
        cause, also = pair
        both = next(name for name in mended if set(name.split(" + ")) == {cause, also})
        decided = both, f"{_PARTS[cause]} and {_PARTS[also]}"
        words = f"Neither {_PARTS[cause]} nor {_PARTS[also]} alone mend it, both together do"
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
    step, at, why = told.blames[cause]
    if best == "skill":
        step, plan = tried.step[one.which], tried.plans[one.task]
        at, why = stall_step(one, step, plan.definition.layout), one.active_time(plan, step)
    by = {f"mended_by_{name.replace(' + ', '_and_')}": share for name, share in shares.items()}
    evidence = {**told.evidence, **by}
    how = None if decided is None else tried.mended(decided[0], one.which, decided[1])
    return Failure(one.task, seed, one.episode, cause, also, step, at, _text(why, words), evidence, replaced, how)


def _listed(names: Iterable[str], joint: str) -> str:
    pairs = {f"{a} + {b}": f"{_PARTS[a]} and {_PARTS[b]}" for a in _PARTS for b in _PARTS}
    words = [pairs.get(name) or _COUNTERFACTUALS[name][1] for name in names]
    return f" {joint} ".join(words) if len(words) < 3 else f"{', '.join(words[:-1])} {joint} {words[-1]}"


def _text(*sentences: str) -> str:
    return " ".join(f"{one[0].upper()}{one[1:]}." for one in sentences)
