"""Who is to blame for a failed episode, given which replacements mend it and how much of its task they mend."""

from collections.abc import Collection, Iterable, Mapping
from typing import Any, NamedTuple

from lw_torchrl.evaluation.failure_records import Cause

MARGIN = 0.3  # a clear lead, as a share of the task's failed episodes


class Replacement(NamedTuple):
    """What is replaced, in words, and whose fault it is if that mends an episode."""

    cause: Cause
    words: str


REPLACEMENTS: dict[str, Replacement] = {
    "perception": Replacement("perception", "the true observations"),
    "query": Replacement("query", "the true answers"),
    "plan": Replacement("plan", "the reference plan"),
    "skill": Replacement("skill", "a scripted skill in one step"),
    "gripper": Replacement("gripper", "the gripper under scripted control"),
    "actuation": Replacement("actuation", "the hand's motion under scripted control"),
    "policy": Replacement("policy", "scripted skills in every step"),
    "time": Replacement("out of time", "twice the time"),
}
PAIR_WORDS: dict[str, str] = {"query": "the true answers", "plan": "the reference plan", "skill": "scripted skills"}
_FACTS = ("perception", "query")  # tried only where something was shown or answered wrongly, which is a fact


class Decision(NamedTuple):
    """The cause, a second one, the replacement that counts, and how clearly it leads."""

    cause: Cause
    also: Cause | None = None
    by: str | None = None
    rival: str | None = None  # the next best replacement, where there is any

    @property
    def words(self) -> str:
        """What was replaced; "" if nothing mends."""
        if self.by is None:
            return ""
        pair = [PAIR_WORDS[name] for name in (self.cause, self.also) if name is not None and self.also is not None]
        return " and ".join(pair) or REPLACEMENTS[self.by].words


def decide(mended: Collection[str], shares: Mapping[str, float], null: float = 0.0) -> Decision:
    """The cause of a failed episode.

    What was shown or answered wrongly comes first, if that put right mends. Of the other replacements the one that
    mends most of the task's failed episodes counts; of those about as good the first: the plan, unless scripts that
    follow it succeed; a skill in one step; the gripper or the motion alone. Where two that do not contain each other
    are about as good, or none leads clearly over running the episode again as it was, it is the policy, not told which
    part. Time comes last, then pairs.

    Args:
        mended: the replacements that mend the episode.
        shares: the share of the task's failed episodes that each mends, of those that it was tried in.
        null: the same of nothing replaced.
    """
    led = {name: shares.get(name, 1.0) for name in REPLACEMENTS if name in mended}
    time = led.pop("time", None)
    if not led:
        if time is not None:
            return Decision("out of time", by="time")
        pair = choose_pair(mended, shares)
        return Decision("undecided") if pair is None else Decision(*pair)
    if "policy" in led and any(name in led for name in ("skill", "gripper", "actuation")):
        led.pop("plan", None)  # scripts that follow the plan succeed
    best = _best(led)
    rivals = {name: share for name, share in led.items() if name != best and name not in _WIDER.get(best, ())}
    rival = max(rivals, key=rivals.__getitem__, default=None)
    close = rival is not None and best not in _FACTS and best != "plan" and rivals[rival] > led[best] - MARGIN
    if led[best] < null + MARGIN or (close and best != "policy"):
        return Decision("policy", by=best, rival=rival)
    return Decision(REPLACEMENTS[best].cause, by=best, rival=rival)


_WIDER = {"skill": ("gripper", "actuation", "policy"), "gripper": ("policy",), "actuation": ("policy",)}
"""What replaces more than a replacement, so that it mends what that one mends."""


def _best(led: Mapping[str, float]) -> str:
    facts = [name for name in led if name in _FACTS]
    if facts:
        return max(facts, key=lambda name: led[name])
    best = next(iter(led))
    for name, share in led.items():
        if share >= led[best] + MARGIN:
            best = name
    return best


def choose_pair(mended: Iterable[str], shares: Mapping[str, float]) -> tuple[Cause, Cause, str] | None:
    """The pair that counts, the first the cause: wrong answers, which are a fact; else what alone mends more of the
    task's failed episodes."""
    alone = {**shares, "skill": max(shares.get("skill", 0.0), shares.get("policy", 0.0))}
    found: list[Any] = [name.split(" + ") for name in mended if " + " in name]
    if not found:
        return None
    cause, also = max(found, key=lambda pair: sum(alone.get(name, 0.0) for name in pair))
    by = f"{cause} + {also}"
    if cause != "query" and alone.get(also, 0.0) > alone.get(cause, 0.0):
        cause, also = also, cause
    return cause, also, by
