"""attribute_failures: why episodes failed, by exchanging one part of what acted in them and running them again."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase

from lw_torchrl._checks import check_int, check_scale, missing_keys
from lw_torchrl.envs.episodes import FinishedEpisode
from lw_torchrl.evaluation.failures import Cause, Failure
from lw_torchrl.evaluation.swaps import Again, Which, WithScripts, definitions, own_evaluators, with_true_answers
from lw_torchrl.evaluation.visited import LATE, Explanation, Scripts, Visited, candidates, explain, see, stay
from lw_torchrl.language.plans import ConditionalPlan, Plans, as_plans
from lw_torchrl.language.skills import ScriptedSkill, load_skills
from lw_torchrl.language.tasks import task_id
from lw_torchrl.modules.networks import evaluating
from lw_torchrl.modules.policy import plans_of

TRIED_STEPS = 3
"""Steps in which a skill is exchanged, one at a time, before it is in all of them."""
_MARGIN = 0.3  # by how much of a task's failed episodes one exchange must mend more than another to go before it
_SAME = 0.02  # how far an action may be from the script's and still be the script's


def attribute_failures(
    rollouts: Iterable[FinishedEpisode | TensorDictBase],
    plans: Plans | Mapping[str, ConditionalPlan],
    *,
    actor: Any = None,
    reference: Plans | Mapping[str, ConditionalPlan] | None = None,
    evaluator: Any = None,
    skills: Mapping[str, ScriptedSkill] | None = None,
    seed: int,
    noise_scale: float = 0.1,
    max_steps: int = 500,
    num_envs: int | None = None,
    engine: Any = "vectorized",
    num_threads: int | None = None,
    device: str | torch.device | None = None,
    progress: bool = True,
) -> list[Failure]:
    """Say of each failed episode whether a query was answered wrongly, the plan led astray, a skill was clumsy, or
    more time was all it lacked.

    **A rule explains.** *Query*, if the policy acted on other answers than the query answering function gives in the
    same states; else *plan*, if late in the episode the plan's true step asks for something else than the reference
    plan's; else *skill*. Without ``actor`` that is all. Without a reference the rule is weak: it can tell wrong
    answers, a plan of which no condition holds, and a skill that stays far from where it goes; what else there is, is
    undecided. Even with one it is no proof, since another plan that succeeds asks for other things as well.

    **An exchange decides**, with ``actor``: the very same episode, its noise too, is run again with true answers, where
    they were wrong; with scripted skills in one step of the plan, or, if that mends nothing, in all (where a text is
    no scripted skill, with the expert's actions); with the reference plan; with twice the time. What alone mends the
    episode is its cause. Where several do, the smallest exchange counts: answers, a skill in one step, the plan,
    skills in all steps, unless another one mends clearly more of the task's failed episodes. Time counts where
    nothing else mends. Where no single exchange mends, pairs of them are tried, which give ``cause`` and ``also``.
    One episode that is mended is one bit, and luck has its part in it: ``evidence`` holds how much of the task's failed
    episodes each exchange mended.

    Args:
        rollouts: episodes as :func:`evaluate` gives them to ``on_episode``, or TensorDicts of batch (T,), each one
            episode from its first state on; those with success are left out. Keys: ``observation`` (T, 39) float32,
            ``task_id`` (T,) int64, ``("next", "success")`` (T, 1) bool; of a TensorDict ``episode`` (T,) int64; where
            they are there, ``qaf`` (T, S) bool, the answers that the policy acted on, ``qaf_logits`` (T, S) float32,
            which count before ``qaf``, and ``skill_weights`` (T, S) float32, for the step in force.
        plans: the plans that were carried out.
        actor: what acted: anything with ``plans`` and ``with_plans`` that writes ``action`` and ``skill_weights``. None
            for the rule alone. One that draws its actions cannot be run again alike; its exchanges tell less.
        reference: other plans for the same tasks, which are trusted. Tasks that they lack have no reference.
        evaluator: what answered in the query answering function's place, between it and the actor: a module or
            function that writes ``qaf`` into the tensordict (read with ``observation`` and ``task_id``), or a
            :class:`torchrl.envs.Transform` that does. An evaluator inside the policy is found there.
        skills: the scripted skills by text that are trusted, as from :func:`load_skills`; None for the shipped ones.
        seed, noise_scale, max_steps, engine: with which the episodes were run.
        num_envs, num_threads, device: as for :func:`evaluate`; the result depends on none of them.
        progress: show a bar for each exchange.

    Returns:
        A :class:`Failure` for each failed episode, in the order of the rollouts.

    Raises:
        ValueError: a rollout without a key that is needed, twice the same episode, a task without a plan, plans that
            are not the actor's, or an episode that does not begin as (task, seed, episode) does.

    Warns:
        UserWarning: the policy cannot carry out the reference; no plan is exchanged.

    Example:
        A wrong offset, planted in the skill that reaches:

        >>> import lw_torchrl as lw
        >>> from dataclasses import replace
        >>> plans = lw.Plans({"reach": lw.load_plans("MT10")["reach"]})
        >>> spoilt = {text: replace(skill, offset=(0.1, 0.0, 0.0)) for text, skill in lw.load_skills().items()}
        >>> actor, episodes = lw.ScriptedSkillActor(plans, skills=spoilt), []
        >>> result = lw.evaluate(
        ...     actor,
        ...     tasks="reach",
        ...     episodes_per_task=1,
        ...     seed=1_000,
        ...     max_steps=100,
        ...     also_record=["observation", "task_id", "qaf", "skill_weights"],
        ...     on_episode=episodes.append,
        ... )
        >>> [failure] = attribute_failures(episodes, plans, actor=actor, seed=1_000, max_steps=100)
        >>> failure.cause, failure.swaps
        ('skill', {'skill': True})

    Source: the plan's conditions, its steps and what carries them out are apart, so each can be exchanged.
    """
    answered = as_plans(plans)
    check_int("seed", seed)
    check_scale("noise_scale", noise_scale)
    check_int("max_steps", max_steps, minimum=1)
    if num_envs is not None:
        check_int("num_envs", num_envs, minimum=1)
    if actor is not None and (own := plans_of(actor)) is not None and (other := answered.differences(own)):
        raise ValueError(f"plans differ from the actor's own for {', '.join(other)}; pass the actor's plans")
    trusted = None if reference is None else as_plans(reference)
    table = load_skills() if skills is None else skills
    failed = _failed(rollouts, answered)
    if not failed:
        return []
    names = sorted({task for task, _, _ in failed})
    acted = Plans({task: answered[task] for task in names})
    whole = answered if actor is not None else acted
    seen = [see(task, k, steps, answered, _answers(steps, actor)) for task, k, steps in failed]
    scripts = Scripts(whole, table)
    if trusted is not None:
        trusted = Plans({t: trusted[t] for t in names if t in trusted}) if any(t in trusted for t in names) else None
    theirs = None if trusted is None else Scripts(trusted, table)
    told = {(one.task, one.episode): explain(one, answered, scripts, trusted, theirs) for one in seen}
    if actor is None:
        return [_by_rule(one, told[one.task, one.episode], seed) for one in seen]
    again = Again(
        tasks=definitions(names, answered),
        firsts={(one.task, one.episode): one.steps.get("observation")[0] for one in seen},
        seed=seed,
        noise_scale=noise_scale,
        max_steps=max_steps,
        num_envs=num_envs,
        engine=engine,
        num_threads=num_threads,
        device=device,
        progress=progress,
    )
    swaps = _Swaps(actor, whole, evaluator, trusted, scripts, table, again)
    swaps.run(seen)
    shares = swaps.shares()
    return [_by_swaps(one, told[one.task, one.episode], swaps, shares.get(one.task, {}), seed) for one in seen]


def _failed(
    rollouts: Iterable[FinishedEpisode | TensorDictBase], plans: Plans
) -> list[tuple[str, int, TensorDictBase]]:
    """The failed episodes: task, episode and steps."""
    by_id = {task_id(task): task for task in plans}
    found: list[tuple[str, int, TensorDictBase]] = []
    seen: set[Which] = set()
    for place, rollout in enumerate(rollouts):
        steps = rollout.steps if isinstance(rollout, FinishedEpisode) else rollout
        if not isinstance(steps, TensorDictBase) or steps.batch_dims != 1 or not len(steps):
            raise ValueError(
                f"rollouts[{place}] must be a finished episode, or a TensorDict of batch (T,), got {type(steps).__name__}"
            )
        needed = ["observation", "task_id", ("next", "success")]
        needed += [] if isinstance(rollout, FinishedEpisode) else ["episode"]
        if missing := [key for key in needed if steps.get(key, None) is None]:
            raise missing_keys(steps.keys(True, True), *(str(key) for key in missing))
        given = steps.get("task_id").unique().tolist()
        if len(given) != 1 or given[0] not in by_id:
            raise ValueError(f"rollouts[{place}] must be of one task that plans has, {', '.join(plans)}; got {given}")
        task = by_id[given[0]]
        if isinstance(rollout, FinishedEpisode):
            episode = rollout.episode
        else:
            episodes = steps.get("episode").unique().tolist()
            if len(episodes) != 1:
                raise ValueError(f"rollouts[{place}] must be one episode, got {len(episodes)}: split them")
            episode = episodes[0]
        if (task, episode) in seen:
            raise ValueError(f"rollouts[{place}] is episode {episode} of {task!r} again")
        seen.add((task, episode))
        if not steps.get(("next", "success")).any():
            found.append((task, episode, steps))
    return found


def _answers(steps: TensorDictBase, actor: Any) -> Tensor | None:
    """What the evaluators inside a policy answer in these states, the mean of several; None where that is not known."""
    evaluators = own_evaluators(actor)
    if not evaluators or any(steps.get(key, None) is None for one in evaluators for key in one.in_keys):
        return None
    with torch.no_grad(), evaluating(actor):
        device = next((p.device for p in actor.parameters()), torch.device("cpu"))
        logits = [one.answers(*(steps.get(key).to(device) for key in one.in_keys)) for one in evaluators]
    return torch.stack(logits).mean(0).cpu() > 0


def keys_to_attribute(actor: Any, env: EnvBase) -> list[NestedKey]:
    """What to record of each step, of what is there, for failures to be attributed."""
    there = env.full_observation_spec.keys(True, True)
    keys: list[NestedKey] = ["observation", "task_id", *(["qaf"] if "qaf" in there else [])]
    keys += [key for key in getattr(actor, "in_keys", ()) if key in there]
    keys += [key for key in ("skill_weights", "qaf_logits") if key in getattr(actor, "out_keys", ())]
    return list(dict.fromkeys(keys))


class _Swaps:
    """Runs the exchanges, and keeps what each gave: its name to the episodes that it was tried in, and their first
    successful step."""

    def __init__(
        self,
        actor: Any,
        plans: Plans,
        evaluator: Any,
        reference: Plans | None,
        scripts: Scripts,
        table: Mapping[str, ScriptedSkill],
        again: Again,
    ) -> None:
        self.actor, self.plans, self.evaluator, self.scripts = actor, plans, evaluator, scripts
        self.table, self.again = table, again
        self.found: dict[str, dict[Which, int | None]] = {}
        self.step: dict[Which, int] = {}  # the step whose skill mends the episode
        self.reference, self.other, self.other_evaluator = reference, None, evaluator
        if reference is not None:
            self._carry_out(reference)

    def _carry_out(self, reference: Plans) -> None:
        """Prepare the exchange of plans, for the tasks in which there is one."""
        other = [reference[task] for task in reference.differences(self.plans)]
        self.reference = Plans(other) if other else None
        if self.reference is None:
            return
        try:
            self.other = self.actor.with_plans(self.reference)
            if hasattr(self.evaluator, "with_plans"):
                self.other_evaluator = self.evaluator.with_plans(self.reference)
        except (AttributeError, ImportError, RuntimeError, TypeError, ValueError) as error:
            self.reference = self.other = None
            warnings.warn(
                f"reference: the policy cannot carry it out, so no plan is exchanged ({type(error).__name__}: {error})",
                stacklevel=4,
            )

    def mends(self, name: str, which: Which) -> bool:
        return self.found.get(name, {}).get(which) is not None

    def _unmended(self, which: Sequence[Which], names: Iterable[str]) -> list[Which]:
        return [one for one in which if not any(self.mends(name, one) for name in names)]

    def run(self, seen: Sequence[Visited]) -> None:
        """All exchanges that are worth it."""
        every = [(one.task, one.episode) for one in seen]
        wrong = [w for w, one in zip(every, seen, strict=True) if bool((one.given != one.truth).any())]
        with_reference = [w for w in every if self.reference is not None and w[0] in self.reference]
        true = with_true_answers(self.actor)
        can_answer = self.evaluator is not None or true is not self.actor
        if can_answer:
            self._run("query", "true answers", wrong, true, self.plans)
        self._skills(seen)
        self._run("plan", "the reference plan", with_reference, self.other, self.reference, self.other_evaluator)
        left = self._unmended(every, ("query", "skill", "skills", "plan"))
        self._run("time", "twice the time", left, self.actor, self.plans, self.evaluator, longer=2)
        left = self._unmended(left, ("time",))
        if can_answer:
            pair = [one for one in left if one in wrong]
            self._run("query + skill", "true answers and scripts", pair, self._scripted(true, self.plans), self.plans)
            if self.other is not None and self.reference is not None:
                both = [one for one in pair if one in with_reference]
                other = with_true_answers(self.other)
                self._run("query + plan", "true answers and the reference plan", both, other, self.reference)
        if self.other is not None and self.reference is not None:
            left = [one for one in self._unmended(left, ("query + skill", "query + plan")) if one in with_reference]
            other = self._scripted(self.other, self.reference)
            what = "the reference plan and scripts"
            self._run("plan + skill", what, left, other, self.reference, self.other_evaluator)

    def _run(
        self,
        name: str,
        what: str,
        which: Sequence[Which],
        actor: Any,
        plans: Plans | None,
        evaluator: Any = None,
        longer: int = 1,
    ) -> None:
        if which and actor is not None and plans is not None:
            self.found.setdefault(name, {}).update(self.again(what, which, actor, plans, evaluator, longer))

    def _scripted(self, actor: Any, plans: Plans, steps: Mapping[Which, int] | None = None) -> WithScripts:
        scripts = self.scripts if plans is self.plans else Scripts(plans, self.table)
        return WithScripts(actor, plans, scripts, steps)

    def _skills(self, seen: Sequence[Visited]) -> None:
        """Scripts in one step, for the likeliest steps in turn, then in all of them."""
        ranked = {}
        for one in seen:
            unlike = unlike_scripts(self.actor, one, self.scripts)
            if unlike is None or unlike.any():
                ranked[one.task, one.episode] = candidates(one, unlike)
        for turn in range(TRIED_STEPS):
            which = self._unmended([w for w, steps in ranked.items() if len(steps) > turn], ("skill",))
            steps = {one: ranked[one][turn] for one in which}
            what = f"scripts in a step ({turn + 1} of up to {TRIED_STEPS})"
            scripted = self._scripted(self.actor, self.plans, steps)
            self._run("skill", what, which, scripted, self.plans, self.evaluator)
            self.step.update({one: steps[one] for one in which if self.mends("skill", one)})
        which = self._unmended([w for w, steps in ranked.items() if len(steps) > 1], ("skill",))
        self._run(
            "skills", "scripts in all steps", which, self._scripted(self.actor, self.plans), self.plans, self.evaluator
        )

    def shares(self) -> dict[str, dict[str, float]]:
        """Task to the share of its failed episodes that each exchange mends, of those it was tried in."""
        found: dict[str, dict[str, float]] = {}
        for name, results in self.found.items():
            for task in {task for task, _ in results}:
                bits = [hit is not None for (of, _), hit in results.items() if of == task]
                found.setdefault(task, {})[name] = sum(bits) / len(bits)
        return found


def unlike_scripts(actor: Any, seen: Visited, scripts: Scripts) -> Tensor | None:
    """(T,) bool, the states in which the policy does something else than the scripted skill of the step it is in.

    None where it cannot be asked, since it reads what was not recorded or draws its actions.
    """
    if getattr(actor, "draws", True):
        return None
    keys = [key for key in actor.in_keys if key != "qaf"]
    if any(seen.steps.get(key, None) is None for key in keys):
        return None
    states = seen.steps.select(*keys).clone()
    if "qaf" in actor.in_keys:
        width = actor.plans.num_steps
        states.set("qaf", torch.nn.functional.pad(seen.given, (0, width - seen.given.shape[1])))
    with torch.no_grad(), evaluating(actor):
        device = next((p.device for p in actor.parameters()), torch.device("cpu"))
        action = actor(states.to(device)).get("action").cpu()
    rows = torch.arange(len(action))
    wanted = scripts.program(seen.steps.get("observation"), seen.steps.get("task_id"))[rows, seen.in_force]
    unscripted = ~torch.tensor(scripts.known[seen.task])[seen.in_force]
    return ((action - wanted).abs().amax(-1) > _SAME) | unscripted


def _by_rule(one: Visited, told: Explanation, seed: int) -> Failure:
    why = told.why[told.cause]
    if told.cause == "undecided":
        why = f"the states alone do not tell: {why}"
    return Failure(
        one.task,
        seed,
        one.episode,
        told.cause,
        None,
        told.steps[told.cause],
        told.at[told.cause],
        _sentence(why),
        told.evidence,
    )


_ORDER = ("query", "skill", "plan", "skills")
_WORDS = {
    "query": "true answers",
    "skill": "the scripted skill in that step",
    "skills": "scripted skills in all steps",
    "plan": "the reference plan",
    "time": "twice the time",
}
_PAIRS: tuple[tuple[Cause, Cause], ...] = (("query", "skill"), ("query", "plan"), ("plan", "skill"))


def decide(mended: Iterable[str], shares: Mapping[str, float]) -> str | None:
    """Of the exchanges that mend an episode, the one that counts: the smallest, unless another one mends more of the
    task's failed episodes by 0.3 of them; None of none.

    Args:
        mended: of "query", "skill", a script in one step, "plan", "skills", scripts in all steps, and "time".
        shares: for each, the share of the task's failed episodes that it mends.

    Example:
        >>> decide(["plan", "skill"], {"plan": 0.5, "skill": 0.5}), decide(["plan", "skill"], {"plan": 0.9, "skill": 0.1})
        ('skill', 'plan')
    """
    given = set(mended)
    found = [name for name in _ORDER if name in given]
    if not found:
        return "time" if "time" in given else None
    best = found[0]
    for name in found[1:]:
        if shares.get(name, 0.0) >= shares.get(best, 0.0) + _MARGIN:
            best = name
    return best


def _by_swaps(one: Visited, told: Explanation, swaps: _Swaps, shares: Mapping[str, float], seed: int) -> Failure:
    which = one.task, one.episode
    tried = {name: results[which] for name, results in swaps.found.items() if which in results}
    mended = [name for name, hit in tried.items() if hit is not None]
    best = decide([name for name in mended if "+" not in name], shares)
    evidence = dict(told.evidence)
    evidence |= {f"mends_{name.replace(' + ', '_and_')}": share for name, share in shares.items()}
    shown: dict[str, bool] = {}
    for name, hit in tried.items():
        name = "skill" if name == "skills" else name
        shown[name] = shown.get(name, False) or hit is not None
    cause: Cause = "undecided"
    also: Cause | None = None
    words = ""
    if best == "plan" and told.evidence.get("plan_departs") == 0.0:
        words = (
            "the reference plan mends it, though in every state it asks for what the plan asks for: by other words, or "
            "by luck"
        )
    elif best is not None:
        cause = {"skills": "skill", "time": "out of time"}.get(best, best)  # type: ignore[assignment]
        step = tried[best]
        words = f"with {_WORDS[best]} the same episode succeeds, at step {step}"
        if rest := [_WORDS[name] for name in mended if name != best and "+" not in name]:
            words += f"; so it does with {' or '.join(rest)}, a larger exchange or one that mends less of the task"
    else:
        pairs = [pair for pair in _PAIRS if " + ".join(sorted(pair, key=["query", "plan", "skill"].index)) in mended]
        if pairs:
            cause, also = max(pairs, key=lambda pair: sum(_alone(name, shares) for name in pair))
            if cause != "query" and _alone(also, shares) > _alone(cause, shares):
                cause, also = also, cause
            words = f"neither {cause} nor {also} alone mends it, both together do"
        elif tried:
            words = f"neither {' nor '.join(_named(name) for name in shown)} mends it"
        else:
            words = "there was nothing to exchange"
    key = cause
    step = told.steps[key]
    at = told.at[key]
    if best == "skill" and cause == "skill" and which in swaps.step:
        step = swaps.step[which]
        at = stay(one.in_force == step)
    why = told.why[key]
    if cause == "skill" and step is not None and step != told.steps["skill"]:
        late = min(LATE, len(one.in_force))
        inside = int((one.in_force == step)[-late:].sum())
        why = f"step {step + 1}, '{swaps.plans[one.task].steps[step].skill}', was in force in {inside} of the last {late} states"
    if cause == "undecided" and told.cause != "undecided":
        words += f"; by the states alone it would be the {told.cause}: {told.why[told.cause]}"
    return Failure(
        one.task, seed, one.episode, cause, also, step, at, f"{_sentence(why)} {_sentence(words)}", evidence, shown
    )


def _named(name: str) -> str:
    return " and ".join(_WORDS[part] for part in name.split(" + "))


def _alone(name: str, shares: Mapping[str, float]) -> float:
    return max(shares.get(name, 0.0), shares.get("skills", 0.0) if name == "skill" else 0.0)


def _sentence(words: str) -> str:
    return words[0].upper() + words[1:] + "."
