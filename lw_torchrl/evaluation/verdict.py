"""The verdict on a failed episode: of what the states tell and what the exchanges mended."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from lw_torchrl.evaluation.exchanges import Exchanges
from lw_torchrl.evaluation.failures import Cause, Failure
from lw_torchrl.evaluation.visited import Explanation, Visited, in_charge, settled

MARGIN = 0.3
"""By how much of a task's failed episodes an exchange must mend more than a smaller one to count before it."""
_ORDER = ("query", "skill", "plan", "skills")
_WORDS = {
    "query": "true answers",
    "skill": "a script in one step",
    "plan": "the reference plan",
    "skills": "scripts in all steps",
    "time": "twice the time",
}
_PARTS = {"query": "true answers", "plan": "the reference plan", "skill": "scripts"}
_CAUSE: dict[str, Cause] = {
    "query": "query",
    "skill": "skill",
    "plan": "plan",
    "skills": "skill",
    "time": "out of time",
}
_PAIRS: dict[str, tuple[Cause, Cause]] = {
    "query + skill": ("query", "skill"),
    "query + plan": ("query", "plan"),
    "plan + skill": ("plan", "skill"),
}


def decide(mended: Iterable[str], shares: Mapping[str, float]) -> str | None:
    """Of the single exchanges that mend an episode, the one that counts: the smallest, unless a larger one mends more
    of the task's failed episodes by 0.3 of them. More time counts alone; None of none.

    Args:
        mended: of "query", "skill", a script in one step, "plan", "skills", scripts in all steps, and "time".
        shares: for each, the share of the task's failed episodes that it mends.

    Example:
        >>> decide(["plan", "skill"], {"plan": 0.5, "skill": 0.5})
        'skill'
        >>> decide(["plan", "skill"], {"plan": 0.9, "skill": 0.1})
        'plan'
    """
    given = set(mended)
    best = None
    for name in _ORDER:
        if name in given and (best is None or shares.get(name, 0.0) >= shares.get(best, 0.0) + MARGIN):
            best = name
    return best or ("time" if "time" in given else None)


def decide_pair(mended: Iterable[str], shares: Mapping[str, float]) -> tuple[Cause, Cause] | None:
    """The pair that counts, the first the cause: wrong answers, which are a fact; else what alone mends more of the
    task's failed episodes."""
    alone = {**shares, "skill": max(shares.get("skill", 0.0), shares.get("skills", 0.0))}
    found = [_PAIRS[name] for name in mended if name in _PAIRS]
    if not found:
        return None
    cause, also = max(found, key=lambda pair: sum(alone.get(name, 0.0) for name in pair))
    later = cause != "query" and alone.get(also, 0.0) > alone.get(cause, 0.0)
    return (also, cause) if later else (cause, also)


def by_rule(one: Visited, told: Explanation, seed: int) -> Failure:
    """What the states alone tell."""
    cause = told.cause
    words = ("The states alone do not tell", told.why[cause]) if cause == "undecided" else (told.why[cause],)
    return Failure(
        one.task, seed, one.episode, cause, None, told.steps[cause], told.at[cause], _text(*words), told.evidence
    )


def by_exchanges(
    one: Visited, told: Explanation, exchanges: Exchanges, shares: Mapping[str, float], seed: int
) -> Failure:
    """What the exchanges tell, explained by the states."""
    which = one.task, one.episode
    tried = {name: results[which] for name, results in exchanges.found.items() if which in results}
    mended = [name for name, hit in tried.items() if hit is not None]
    swaps: dict[str, bool] = {}
    for name in tried:
        shown = "skill" if name == "skills" else name
        swaps[shown] = swaps.get(shown, False) or name in mended
    cause: Cause = "undecided"
    also: Cause | None = None
    same = told.evidence.get("plan_departs") == 0.0
    best = decide([name for name in mended if not (same and name == "plan")], shares)
    pair = None if best else decide_pair(mended, shares)
    if best is not None:
        cause = _CAUSE[best]
        words = f"With {_WORDS[best]} the same episode succeeds, at step {tried[best]}"
        if others := [name for name in mended if name in _ORDER and name != best]:
            words += f"; with {_listed(others, 'and')} too, which is more to exchange or mends less of the task"
    elif pair is not None:
        cause, also = pair
        words = f"Neither {_PARTS[cause]} nor {_PARTS[also]} alone mend it, both together do"
    elif same and "plan" in mended:
        words = "With the reference plan it succeeds, though in no state that asks for anything else"
    elif told.cause == "query" and "query" not in tried:
        cause, words = "query", "These answers could not be exchanged"
    elif tried:
        words = f"It fails as well with {_listed(tried, 'or with')}"
    else:
        words = "There is nothing to exchange"
    if cause == "undecided" and told.cause != "undecided":
        words += f". By the states alone it would be the {told.cause}: {told.why[told.cause]}"
    step, at, why = told.steps[cause], told.at[cause], told.why[cause]
    if best == "skill" and cause == "skill":
        step = exchanges.step[which]
        at, why = settled(one, step), in_charge(one, exchanges.plans[one.task], step)
    evidence = {
        **told.evidence,
        **{f"mended_by_{name.replace(' + ', '_and_')}": share for name, share in shares.items()},
    }
    return Failure(one.task, seed, one.episode, cause, also, step, at, _text(why, words), evidence, swaps)


def _listed(names: Iterable[str], joint: str) -> str:
    words = [_WORDS.get(name) or " and ".join(_PARTS[part] for part in name.split(" + ")) for name in names]
    return f" {joint} ".join(words) if len(words) < 3 else f"{', '.join(words[:-1])} {joint} {words[-1]}"


def _text(*sentences: str) -> str:
    return " ".join(f"{one[0].upper()}{one[1:]}." for one in sentences)
