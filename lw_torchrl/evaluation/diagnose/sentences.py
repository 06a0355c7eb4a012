"""English sentences for failures and findings; no other module converts a diagnosis to text."""

from __future__ import annotations

from lw_torchrl.evaluation.diagnose.failure import (
    REPLACEMENTS,
    ActiveStep,
    Difference,
    Failure,
    Finding,
    Misled,
    NoCondition,
    PlanDeparts,
    WrongAnswers,
    WrongMotion,
)

_TEXTS = {
    "environment": ("the suite's own engine", "the engine"),
    "perception": ("the true observations", "the observations"),
    "query": ("the true answers", "the answers"),
    "plan": ("the reference plan", "the plan"),
    "wrapper": ("the actions that the policy's innermost module decides", "the changed actions"),
    "skill": ("a scripted skill in one step", "the skill of one step"),
    "gripper": ("the gripper under scripted control", "the gripper's commands"),
    "actuation": ("the hand's motion under scripted control", "the hand's motion"),
    "policy": ("scripted skills in every step", "all actions"),
    "no noise": ("no noise", "the noise"),
    "time": ("twice the time", "the time limit"),
}
"""A mapping from each cause to the part that its replacement inserts, and the part that is removed."""
_IN_PAIRS = _TEXTS | {"skill": ("scripted skills", "all actions")}


def replacement_text(name: str) -> str:
    """Return the parts that a replacement inserts, for example "the true answers and scripted skills"."""
    return " and ".join(_texts(name, 0))


def replaced_text(name: str) -> str:
    """Return the parts that a replacement removes, for example "the answers and all actions"."""
    return " and ".join(_texts(name, 1))


def _texts(name: str, number: int) -> list[str]:
    return [_TEXTS[name][number]] if name in _TEXTS else [_IN_PAIRS[cause][number] for cause in REPLACEMENTS[name]]


def explain_failure(failure: Failure) -> str:
    """Explain in a few sentences why an episode failed."""
    parts = [] if failure.finding is None else [finding_text(failure.finding)]
    if failure.cause in ("environment differs", "not reproducible"):
        others = "" if failure.cause == "environment differs" else ", and other episodes of the task succeed"
        ending = f"fails in a different way{others}" if failure.succeeds_at is None else "succeeds"
        parts = [f"a plain re-run {ending}", *parts]
    elif not failure.shares:  # no episode was re-run, so only the rule decided the cause
        parts = ["The states alone do not show the cause", *parts] if failure.cause == "undecided" else parts
    else:
        parts += _counterfactual_texts(failure)
    return " ".join(f"{part[0].upper()}{part[1:]}." for part in parts)


def _counterfactual_texts(failure: Failure) -> list[str]:
    """Return clauses that describe the results of re-running the episode."""
    if failure.also is not None and failure.replaced is not None:
        first, second = _IN_PAIRS[failure.cause][0], _IN_PAIRS[failure.also][0]
        return [f"neither {first} nor {second} is enough; with both, the episode succeeds"]
    if failure.replaced is not None:
        return [_success_text(failure)]
    if failure.counterfactuals.get("plan"):
        parts = ["the episode succeeds with the reference plan, but both plans request the same action in every state"]
    elif failure.cause == "query":
        parts = ["these answers could not be replaced"]
    elif failure.counterfactuals:
        *texts, last = map(replacement_text, failure.counterfactuals)
        parts = [f"the episode also fails with {' or with '.join([*filter(None, [', '.join(texts)]), last])}"]
    else:
        parts = ["no part of the policy could be replaced"]
    return parts if failure.suspect is None else [*parts, f"the states alone suggest the {failure.suspect}"]


def _success_text(failure: Failure) -> str:
    """Return a clause with the replacement that helps, and the fractions of failed episodes that re-runs fix."""
    assert failure.replaced is not None
    share = failure.shares.get
    text = f"with {replacement_text(failure.replaced)} the same episode succeeds, at t = {failure.succeeds_at}"
    shares = [f"this fixes {share(failure.replaced, 1.0):.0%} of the task's failed episodes"]
    if "no noise" in failure.shares and failure.replaced != "no noise":
        shares.append(f"a re-run without noise {share('no noise', 0.0):.0%}")
    shares.append(f"a plain re-run {share('nothing', 0.0):.0%}")
    return f"{text}; {', '.join(shares)}"


def finding_text(finding: Finding) -> str:
    """Express a finding as a clause with numbers."""
    # Plan steps are counted from 1 in texts, and from 0 in the data.
    match finding:
        case WrongAnswers(step, condition, states, of, first):
            often = f"{states} of {of} states, first at {first}"
            return f"'{condition}' (step {step + 1}) was answered wrongly in {often}"
        case NoCondition(states, of):
            return f"no condition of the plan held in {states} of the last {of} states"
        case PlanDeparts(step, skill, reference, states, of, late, uncovered):
            departs = f"the plan requests a different action than the reference in step {step + 1}, '{skill}'"
            departs = "no condition of the plan holds" if uncovered else departs
            often = f"in {states} of {'the last ' if late else ''}{of} states"
            return f"{often} {departs}, where the reference requests '{reference}'"
        case ActiveStep(step, skill, states, of, distance):
            text = f"step {step + 1}, '{skill}', was active in {states} of the last {of} states"
            return text if distance is None else f"{text} and ended {100 * distance:.0f} cm from its target"
        case Misled(error, number):
            wrong = f"entry {number} was off by up to {error:.2g}"
            return f"the policy's observation differed from the true one: {wrong}"
        case WrongMotion(part, right, shape, error, steps):
            what = {"motion": "the hand's motion", "gripper": "the gripper's command"}[part]
            than = {
                "decided": "what the policy's innermost module decided",
                "commanded": "what the policy commanded plus the noise",
                "scripted": "the scripted skill's",
            }
            where = f"in {steps} plan step{'s' if steps > 1 else ''}, by {error:.2g} (root mean square)"
            return f"{what} differed from {than[right]} {where}: it was {shape}"
        case Difference(part, at, given, again, size):
            differ = f"from step {at} on, by {size or 0:.2g} at that step, due to noise or a random policy"
            texts = {
                "length": f"the length: the rollout has {given} steps, the re-run {again}",
                "actions": f"the executed actions, {differ}",
                "environment": (
                    f"the environment: the same action in state {at - 1} leads to a different state"
                    if at
                    else "the first state; check that seed, suite and engine are those of the rollout"
                ),
                "states": f"the states, from {at} on; the rollout holds no actions, so record them to find out more",
                "nothing": "in data that were not recorded",
            }
            return f"the first difference is {texts[part]}"
