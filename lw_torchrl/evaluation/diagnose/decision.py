"""Decide the cause of a failed episode, given which replacements help and how much of its task each one fixes."""

from collections.abc import Collection, Iterable, Mapping
from typing import NamedTuple

from lw_torchrl.evaluation.diagnose.findings import REPLACEMENTS, Cause

MARGIN = 0.3  # a clear lead, as a share of the task's failed episodes
_FACTS = ("perception", "query")  # tried only if an observation or answer was wrong, which is a fact
_WIDER = {"skill": ("gripper", "actuation", "policy"), "gripper": ("policy",), "actuation": ("policy",)}
"""Replacements that contain another one, so that they fix every episode that it fixes."""


class Decision(NamedTuple):
    """The cause, a second cause, the replacement that counts, and the next best replacement."""

    cause: Cause
    also: Cause | None = None
    by: str | None = None
    rival: str | None = None


def decide(mended: Collection[str], shares: Mapping[str, float], null: float = 0.0) -> Decision:
    """Return the cause of a failed episode, from the replacements with which it succeeds (``mended``).

    ``shares`` is the share of the task's failed episodes that each replacement fixes, among those it was tried on, and
    ``null`` that of a plain re-run.

    Wrong observations and answers come first, if correcting them helps. Of the other replacements, the one that fixes
    most of the task's failed episodes counts. Among those about as good, the first counts: the plan, unless scripts
    that follow it succeed; a skill in one step; the gripper or the motion. It is the policy, without naming a part, if
    two replacements that do not contain each other are about as good, or if none leads clearly over a plain re-run.
    Time comes last, then pairs.
    """
    single = {name: causes[0] for name, causes in REPLACEMENTS.items() if len(causes) == 1}
    led = {name: shares.get(name, 1.0) for name in single if name in mended}
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
    return Decision(single[best], by=best, rival=rival)


def _best(led: Mapping[str, float]) -> str:
    if facts := [name for name in led if name in _FACTS]:
        return max(facts, key=lambda name: led[name])
    best = next(iter(led))
    for name, share in led.items():
        if share >= led[best] + MARGIN:
            best = name
    return best


def choose_pair(mended: Iterable[str], shares: Mapping[str, float]) -> tuple[Cause, Cause, str] | None:
    """Return the pair of causes that counts, with its replacement; first wrong answers, else what fixes more alone."""
    alone = {**shares, "skill": max(shares.get("skill", 0.0), shares.get("policy", 0.0))}
    pairs = [name for name in mended if len(REPLACEMENTS[name]) > 1]
    if not pairs:
        return None
    by = max(pairs, key=lambda name: sum(alone.get(cause, 0.0) for cause in REPLACEMENTS[name]))
    cause, also = REPLACEMENTS[by]
    if cause != "query" and alone.get(also, 0.0) > alone.get(cause, 0.0):
        cause, also = also, cause
    return cause, also, by
