"""What a plan's steps say, in anyone's words: a verb, the thing that is moved, its target, a direction."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace

from lw_torchrl.language.named_objects import GOAL, GRIPPER
from lw_torchrl.language.phrases import plain
from lw_torchrl.language.plans import ConditionalPlan, PlanStep
from lw_torchrl.language.roles import Direction, Verb
from lw_torchrl.language.skills import WORDS
from lw_torchrl.language.tasks import Task
from lw_torchrl.language.things import first_thing, is_goal, mark, same_thing, thing_of, things

_VERBS = {name: frozenset(words) for name, words in WORDS["canonical"]["verbs"].items()}
_DIRECTIONS: dict[str, Direction] = {
    word: name for name, words in WORDS["canonical"]["directions"].items() for word in words
}
_PLACES = {name: frozenset(words) for name, words in WORDS["canonical"]["places"].items()}
_KNOWN = frozenset().union(*_VERBS.values()) | {"align", "slide", "sweep"}
# "above the dial to turn it left": a later step's business
_PURPOSE = re.compile(r"(?<=>) (?:in order )?to \w+ it\b.*")
_TOOL = re.compile(r"(?<!line )(?<!level )(?<!aligned )\bwith <([^>]*)>")


@dataclass(frozen=True)
class Reading:
    """What one step says.

    Attributes:
        verb: what is done.
        moved: what is to arrive at the target: the robot's gripper, or a thing that it holds; None if unknown.
        target: the object or point to go to; None if unknown.
        direction: where a thing is pushed, pulled or moved to; "goal" from the thing to what it is brought to.
        toward: what that is; None for the task's goal.
        sure: 1 where the words say it, less where the condition, or what is usual, had to.
    """

    verb: Verb  # "carry" goes through the air, "move" straight
    moved: str | None
    target: str | None
    direction: Direction | None = None
    sure: float = 1.0
    toward: str | None = None


def compared_with_gripper(step: PlanStep) -> tuple[str, ...]:
    """What a step's condition compares with the gripper, in its order."""
    pairs = [(one.subject, one.object) for one in step.condition.clauses if one.object is not None]
    return tuple(second if first == GRIPPER else first for first, second in pairs if GRIPPER in (first, second))


@dataclass(frozen=True)
class _Facts:
    """What a condition says of the gripper."""

    at: bool  # near or around a thing
    not_at: bool
    aligned: bool  # any other relation
    not_aligned: bool
    open: bool
    closed: bool
    near: tuple[str, ...]  # the things that it is compared with

    @classmethod
    def of(cls, step: PlanStep) -> _Facts:
        said = {name: False for name in ("at", "not_at", "aligned", "not_aligned", "open", "closed")}
        for clause in step.condition.clauses:
            if clause.subject == GRIPPER and clause.object is None:
                said["open" if (clause.predicate == "open") != clause.negated else "closed"] = True
            elif clause.object is not None and GRIPPER in (clause.subject, clause.object):
                relation = "at" if clause.predicate in ("near", "around") else "aligned"
                said[f"not_{relation}" if clause.negated else relation] = True
        return cls(near=compared_with_gripper(step), **said)


def read_steps(plan: ConditionalPlan) -> tuple[Reading | None, ...]:
    """What each step says; None for a step that says nothing that can be read."""
    task = plan.definition
    facts = [_Facts.of(step) for step in plan.steps]
    marked = [mark(step.skill, task) for step in plan.steps]
    read = _read(plan, _without_it([plain(text) for text in marked], facts, task), facts)
    if all(one is None or one.verb in _NO_MOTION for one in read):  # "grab it and pull" in a step
        read = _read(plan, _without_it([_last_clause(text) for text in marked], facts, task), facts)
    return read


_IT = re.compile(r"^(\w+) (?:it|them|her|him)\b")
_NO_MOTION = {"approach", "beside", "descend", "close", "open"}


def _last_clause(text: str) -> str:
    """What comes last, of a thing that came first: "grab <mug> and pull it back" is "pull <mug> back"."""
    first, _, second = text.rpartition(" and ")
    thing = next((name for name in re.findall(r"<[^>]*>", first) if name != f"<{GRIPPER}>"), "it")
    return plain(re.sub(r"\b(?:it|them)\b", thing, second, count=1)) if first else plain(text)


def _read(plan: ConditionalPlan, texts: list[str], facts: list[_Facts]) -> tuple[Reading | None, ...]:
    task = plan.definition
    grasping = any(_grasps(text, one) for text, one in zip(texts, facts, strict=True))
    read = [
        _Step(step, task, text, one, grasping).read() for step, text, one in zip(plan.steps, texts, facts, strict=True)
    ]
    if not any(one and one.verb not in ("approach", "descend", "beside") for one in read):
        read = [_sent(one, text) for one, text in zip(read, texts, strict=True)]
    return tuple(_pushed_or_pulled(read))


def _without_it(texts: Iterable[str], facts: Iterable[_Facts], task: Task) -> list[str]:
    """Texts in which "pull it" says what is pulled: what the step before was done to, else the first thing."""
    found, before = [], first_thing(task)
    for text, one in zip(texts, facts, strict=True):
        meant = before or (one.near[-1] if one.near else None)
        if meant is not None and (said := _IT.match(text)):
            meant = GRIPPER if f"<{meant}>" in text else meant  # "park it over <mug>", which is the mug already
            text = f"{said[1]} <{meant}>{text[said.end() :]}"
        found.append(text)
        named = (name for name in re.findall(r"<([^>]*)>", text) if name != GRIPPER and not is_goal(task, name))
        before = next(named, before)
    return found


def _sent(read: Reading | None, text: str) -> Reading | None:
    """ "move the gripper to the block", in a plan that does nothing with it, is all that there is to do."""
    to_it = read is not None and read.verb == "descend" and re.match(rf"\w+ <{GRIPPER}> (?:to|at|toward|onto) <", text)
    return replace(read, verb="reach") if read is not None and to_it else read


def _grasps(text: str, facts: _Facts) -> bool:
    """Whether a step closes the gripper around a thing, carries one, or speaks of a closed gripper at it."""
    verb, *rest = text.split()
    if verb in _VERBS["held"] and rest and rest[0].startswith("<") and not text.startswith(f"{verb} <{GRIPPER}>"):
        return True
    return (verb in _VERBS["close"] and (verb != "close" or GRIPPER in text)) or (facts.closed and facts.at)


def _pushed_or_pulled(read: Iterable[Reading | None]) -> list[Reading | None]:
    """Where the words leave it open: a thing is pulled by a hand that came down around it, else pushed."""
    read = list(read)
    verbs = {one.verb for one in read if one is not None}
    if "beside" in verbs:
        return [replace(one, verb="push") if one and one.verb == "pull" else one for one in read]
    around = "descend" in verbs
    return [
        replace(one, verb="pull") if one and one.verb == "push" and one.sure < 0.6 and around else one for one in read
    ]


class _Step:
    """One step, while it is read."""

    def __init__(self, step: PlanStep, task: Task, text: str, facts: _Facts, grasping: bool) -> None:
        self.step, self.task, self.text, self.facts, self.grasping = step, task, text, facts, grasping
        text = _PURPOSE.sub("", text)
        self.verb, *rest = re.sub(r"<[^>]*>", " ", text).split() or [""]
        self.words = set(rest)
        named = re.findall(r"<([^>]*)>", text)
        self.by_hand = named[:1] == [GRIPPER]
        self.named = [name for name in named if name != GRIPPER]
        self.tool = found[1] if (found := _TOOL.search(text)) else None
        if self.tool is not None:
            self.named = [name for name in self.named if name != self.tool] or self.named
        self.direction = next((_DIRECTIONS[word] for word in rest if word in _DIRECTIONS), None)
        self.first = first_thing(task)
        self.near = facts.near[-1] if facts.near else self.first

    def read(self) -> Reading | None:
        found, known = self._read(), self.verb in _KNOWN
        if found is None or (known and self.named):
            return found
        if not known and not self.named and not self.by_hand:
            return None
        return replace(found, sure=min(found.sure, 0.8 if known else 0.6))

    def _read(self) -> Reading | None:
        if self.first is None:
            elsewhere = self.named and not any(is_goal(self.task, name) for name in things(self.task))
            target = self.named[-1] if elsewhere else GOAL
            return Reading("hold" if self.verb in _VERBS["hold"] else "reach", GRIPPER, target)
        thing = self.named[0] if self.named else self.near
        if thing is None:
            return None
        if is_goal(self.task, thing) and not self.by_hand and self.verb not in _VERBS["go"]:
            at_goal = self.near is None or is_goal(self.task, self.near)
            thing = self.first if at_goal else thing_of(self.task, str(self.near))
        opens = self.verb in _VERBS["open"] and GRIPPER in self.text and not self.words & {"around", "onto", "on"}
        if opens or self.verb == "release":
            return Reading("open", GRIPPER, thing)
        if self.verb in _VERBS["close"] and (self.verb != "close" or GRIPPER in self.text or self.grasping):
            return self._closed(thing)
        return self._by_hand() if self.by_hand else self._thing_moved(thing)

    def _closed(self, thing: str) -> Reading:
        """ "grab the mug" of a hand that is not there yet is the way to it, and of one that has it, up with it."""
        if self.facts.not_at and not self.facts.at and not self.facts.closed:
            return Reading("descend", GRIPPER, thing)
        if self.verb == "pick" and self.facts.closed and not self.facts.open:
            return Reading("move", thing, thing, "up")
        return Reading("close", GRIPPER, thing)

    def _by_hand(self) -> Reading | None:
        """The gripper is what is put somewhere; what it holds goes with it."""
        target = self.named[-1] if self.named else self.near
        if target is None:
            return None
        holds = self.grasping and (self.facts.closed or self.facts.at)
        if is_goal(self.task, target):
            if holds:
                return Reading("carry", self.first, target)
            return Reading("hold" if self.verb in _VERBS["hold"] else "reach", GRIPPER, target)
        above = bool(self.words & _PLACES["above"])
        if self.grasping and self.facts.closed and self.facts.at and (above or "to" in self.words):
            elsewhere = self.near is None or not same_thing(self.task, target, self.near)
            return Reading("carry", self.first, target if elsewhere else GOAL)
        if above or self.verb == "raise":
            return Reading("approach", GRIPPER, target)
        if "front" in self.words:
            return Reading("beside", GRIPPER, target, "away")
        if "behind" in self.words:
            return Reading("beside", GRIPPER, target, "toward")
        if self.words & _PLACES["beside"]:
            return Reading("beside", GRIPPER, target)
        if self.verb == "align":
            return Reading("descend" if self.facts.aligned else "approach", GRIPPER, target)
        down = self.verb in ("lower", "drop") or self.words & _PLACES["around"]
        far = self.facts.not_aligned and not self.facts.aligned and not self.facts.not_at
        return Reading("approach" if far and not down else "descend", GRIPPER, target)

    def _thing_moved(self, thing: str) -> Reading:
        target = self._target(thing)
        moved = self.tool if self.tool is not None and (target is None or not is_goal(self.task, target)) else thing
        if target is not None:
            moved = self._compared_point(moved, target)
        if self.grasping:
            if target is not None:
                lifted = self.verb in _VERBS["carry"] or self.words & _PLACES["above"]
                return Reading("carry" if lifted else "move", moved, target)
            direction: Direction | None = self.direction if self.direction != "down" else None
            if self.verb in _VERBS["lift"]:
                direction = "up"
            if direction is not None:
                return Reading("move", moved, moved, direction)
            return Reading("carry" if self.verb in _VERBS["carry"] else "move", moved, GOAL, sure=0.7)
        direction = self.direction
        if direction == "down" and self.verb not in ("push", "press"):
            direction = None
        if self.verb in _VERBS["lift"] and direction is None:
            return Reading("pull", GRIPPER, moved, "up")
        if self.verb == "press" or direction == "down":
            return Reading("push", GRIPPER, moved, direction or "goal")
        if self.verb in _VERBS["pull"] or direction == "toward" or "out" in self.words:
            return Reading("pull", GRIPPER, moved, direction or "goal")
        pushed = self.verb in _VERBS["push"] or direction is not None
        toward = None if direction is not None or target is None or is_goal(self.task, target) else target
        return Reading("push", GRIPPER, moved, direction or "goal", sure=1.0 if pushed else 0.5, toward=toward)

    def _target(self, thing: str) -> str | None:
        """Where a thing is moved to, by the words, or by what the condition compares it with."""
        goals = [name for name in self.named if is_goal(self.task, name)]
        if goals:
            return goals[-1]
        for name in reversed(self.named[1:] if self.tool is None else self.named):
            if not same_thing(self.task, name, thing) or self.tool is not None:
                return name
        own = self.tool or thing
        others = [b if same_thing(self.task, a, own) else a for a, b in self._pairs() if self._is_one(a, b, own)]
        return others[-1] if others else None

    def _is_one(self, first: str, second: str, thing: str) -> bool:
        return same_thing(self.task, first, thing) != same_thing(self.task, second, thing)

    def _pairs(self) -> list[tuple[str, str]]:
        """The things that the condition compares; what is at another already is not to come to it."""
        clauses = [one for one in self.step.condition.clauses if one.negated or one.predicate not in ("near", "around")]
        return [(c.subject, c.object) for c in clauses if c.object is not None and GRIPPER not in (c.subject, c.object)]

    def _compared_point(self, moved: str, target: str) -> str:
        """The point on what is moved that the condition compares with the target: the ring, of a wrench."""
        for pair in self._pairs():
            for point, other in (pair, pair[::-1]):
                if same_thing(self.task, other, target) and same_thing(self.task, point, moved):
                    moved = point
        return moved
