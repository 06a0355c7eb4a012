"""The English of a diagnosis: the only place where failures and findings become sentences."""

from __future__ import annotations

from collections.abc import Sequence

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
)

_SOUND = {
    "perception": "the true observations",
    "query": "the true answers",
    "plan": "the reference plan",
    "skill": "a scripted skill in one step",
    "gripper": "the gripper under scripted control",
    "actuation": "the hand's motion under scripted control",
    "policy": "scripted skills in every step",
    "out of time": "twice the time",
}
_REPLACED = {
    "perception": "the observations",
    "query": "the answers",
    "plan": "the plan",
    "skill": "the skill of one step",
    "gripper": "the gripper's commands",
    "actuation": "the hand's motion",
    "policy": "all actions",
    "out of time": "the time limit",
}


def replacement_text(name: str) -> str:
    """Return what a replacement puts in place: "the true answers and scripted skills"."""
    return _joined(name, _SOUND | {"skill": "scripted skills"} if len(REPLACEMENTS[name]) > 1 else _SOUND)


def replaced_text(name: str) -> str:
    """Return what a replacement takes away: "the answers and all actions"."""
    return _joined(name, _REPLACED | {"skill": "all actions"} if len(REPLACEMENTS[name]) > 1 else _REPLACED)


def _joined(name: str, texts: dict[str, str]) -> str:
    return " and ".join(texts[cause] for cause in REPLACEMENTS[name])


def listed(texts: Sequence[str], joint: str) -> str:
    """Return texts as a list in a sentence: "a, b or c"."""
    return f" {joint} ".join(texts) if len(texts) < 3 else f"{', '.join(texts[:-1])} {joint} {texts[-1]}"


def explain_failure(failure: Failure) -> str:
    """Return why an episode failed, in a few sentences."""
    parts = [] if failure.finding is None else [finding_text(failure.finding)]
    if failure.cause == "not reproducible":
        fails = "it fails in another way, and other episodes of the task succeed"
        ended = fails if failure.succeeds_at is None else "it succeeds"
        parts = [f"in a plain re-run {ended}", *parts]
    elif not failure.shares:  # only the rule: nothing was run again
        parts = ["The states alone do not tell", *parts] if failure.cause == "undecided" else parts
    else:
        parts += _counterfactual_texts(failure)
    return " ".join(f"{part[0].upper()}{part[1:]}." for part in parts)


def _counterfactual_texts(failure: Failure) -> list[str]:
    """Return what re-running the episode showed."""
    if failure.also is not None and failure.replaced is not None:
        texts = _SOUND | {"skill": "scripted skills"}
        alone = f"neither {texts[failure.cause]} nor {texts[failure.also]} is enough"
        return [f"{alone}; with both, the episode succeeds"]
    if failure.replaced is not None:
        parts = [_success_text(failure)]
        if failure.cause == "skill" and failure.replaced == "actuation" and failure.step is not None:
            parts.append(f"the motion is wrong only in step {failure.step + 1}")
        if failure.scripted_step is not None:
            suffices = f"a scripted skill in step {failure.scripted_step + 1} suffices too"
            parts.append(f"{suffices}, but the motion is as wrong in other steps")
        return parts
    if failure.counterfactuals.get("plan"):
        parts = ["with the reference plan it succeeds, although both plans request the same in every state"]
    elif failure.cause == "query":
        parts = ["these answers could not be replaced"]
    elif failure.counterfactuals:
        parts = [f"it also fails with {listed([*map(replacement_text, failure.counterfactuals)], 'or with')}"]
    else:
        parts = ["there is nothing to replace"]
    return parts if failure.suspect is None else [*parts, f"the states alone suggest the {failure.suspect}"]


def _success_text(failure: Failure) -> str:
    """Return which replacement helps, and how clearly it leads."""
    assert failure.replaced is not None
    share = failure.shares.get
    text = f"with {replacement_text(failure.replaced)} the same episode succeeds, at t = {failure.succeeds_at}"
    shares = [f"this fixes {share(failure.replaced, 1.0):.0%} of the task's failed episodes"]
    if failure.rival is not None:
        shares.append(f"{replacement_text(failure.rival)} {share(failure.rival, 1.0):.0%}")
    shares.append(f"a plain re-run {share('nothing', 0.0):.0%}")
    return f"{text}; {', '.join(shares)}"


def finding_text(finding: Finding) -> str:
    """Return half a sentence with the finding's numbers."""
    match finding:
        case WrongAnswers(step, condition, states, of, first):
            often = f"{states} of {of} states, first at {first}"
            return f"'{condition}' (step {step + 1}) was answered wrongly in {often}"
        case NoCondition(states, of):
            return f"no condition of the plan held in {states} of the last {of} states"
        case PlanDeparts():
            often = f"{finding.states} of {'the last ' if finding.late else ''}{finding.of}"
            departs = (
                f"the plan requests something else than the reference, in step {finding.step + 1}, '{finding.skill}'"
            )
            departs = "no condition of the plan holds" if finding.uncovered else departs
            return f"in {often} states {departs}, where the reference requests '{finding.reference}'"
        case ActiveStep(step, skill, states, of, distance):
            text = f"step {step + 1}, '{skill}', was active in {states} of the last {of} states"
            return text if distance is None else f"{text} and ended {100 * distance:.0f} cm from its target"
        case Misled(error, number):
            wrong = f"entry {number} was off by up to {error:.2g}"
            return f"the policy was shown another observation than the true one: {wrong}"
        case Difference():
            return f"the first difference is {_difference_text(finding)}"


def _difference_text(difference: Difference) -> str:
    at = difference.at
    match difference.part:
        case "length":
            return f"the length: the rollout has {difference.given} steps, the re-run {difference.again}"
        case "actions":
            return f"the executed actions, from step {at} on, there by {difference.size:.2g}: noise or a random policy"
        case "environment":
            return f"the environment: the same action in state {at - 1} leads to another state"
        case "states":
            return f"the states, from {at} on; the rollout holds no actions, which would tell more"
        case _:
            return "in nothing that was recorded"
