"""A parser that finds the verb, moved object, target and direction of each step in a free-form plan."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from lw_torchrl.language.expressions import TRUE
from lw_torchrl.language.objects import GOAL, GRIPPER, WORDS
from lw_torchrl.language.plans import ConditionalPlan, PlanStep
from lw_torchrl.language.polarity import instruction, rests, source_of, without_source
from lw_torchrl.language.queries import Clause, Query
from lw_torchrl.language.roles import Direction, Verb, ignored_words, mark_objects, simplify
from lw_torchrl.language.tasks import Task, first_object, is_goal, object_of, same_object, whole_objects

_VERBS = {name: frozenset(words) for name, words in WORDS["canonical"]["verbs"].items()}
_DIRECTIONS: dict[str, Direction] = {
    word: name for name, words in WORDS["canonical"]["directions"].items() for word in words
}
_PLACES = {name: frozenset(words) for name, words in WORDS["canonical"]["places"].items()}
_KNOWN = frozenset().union(*_VERBS.values()) | {"align", "slide", "sweep"}
# The purpose ("to turn it left") in "put the gripper above the dial to turn it left"; a later step carries it out.
_PURPOSE = re.compile(r"(?<=>) (?:in order )?to \w+ it\b.*")
_IDLE = re.compile(
    r"(?:stop|wait|pause|finish|done|stay|rest|idle|hold|pass|return|success|(?:do|keep|hold|be) (?:nothing|still))"
    r"(?: (?:here|still|moving|there|now|put))*"
)
_OBSTACLES = frozenset(WORDS["canonical"]["obstacles"])
_TOOL = re.compile(r"(?<!line )(?<!level )(?<!aligned )\bwith <([^>]*)>")


@dataclass(frozen=True)
class ParsedStep:
    """The parsed meaning of one plan step."""

    verb: Verb
    moved: str | None  # what moves: the robot's gripper, or an object that the gripper holds; None if unknown
    target: str | None  # the object or point to move to; None if unknown
    direction: Direction | None = None  # direction of the object's motion; "goal" means toward ``toward``
    confidence: float = 1.0  # lower if the meaning is inferred from the condition or from common usage
    toward: str | None = None  # the object in the direction "goal"; None for the task's goal


def _stated(step: PlanStep) -> tuple[Clause, ...]:
    """Return the clauses that a step's condition implies, or all clauses of the condition if none is implied."""
    return step.condition.implied or step.condition.clauses


def compared_with_gripper(step: PlanStep) -> tuple[str, ...]:
    """Return the objects that a step's condition compares with the gripper, in order of mention, without obstacles."""
    pairs = [(clause.subject, clause.object) for clause in _stated(step) if clause.object is not None]
    names = (second if first == GRIPPER else first for first, second in pairs if GRIPPER in (first, second))
    return tuple(name for name in names if not is_obstacle(name))


@dataclass(frozen=True)
class _Facts:
    """The facts that a condition states about the gripper."""

    at: bool  # "near" or "around" an object
    not_at: bool
    aligned: bool  # in any other relation to an object
    not_aligned: bool
    open: bool
    closed: bool
    near: tuple[str, ...]  # the objects that the condition compares with the gripper, without obstacles

    @classmethod
    def of(cls, step: PlanStep) -> _Facts:
        facts = dict.fromkeys(("at", "not_at", "aligned", "not_aligned", "open", "closed"), False)
        for clause in step.condition.implied:
            if clause.subject == GRIPPER and clause.object is None:
                facts["open" if (clause.predicate == "open") != clause.negated else "closed"] = True
            elif GRIPPER in (pair := (clause.subject, str(clause.object))) and not any(map(is_obstacle, pair)):
                relation = "at" if clause.predicate in ("near", "around") else "aligned"
                facts[f"not_{relation}" if clause.negated else relation] = True
        return cls(near=compared_with_gripper(step), **facts)


def is_free(step: PlanStep) -> bool:
    """Return whether a step's condition states that the gripper is open, or not at an object."""
    facts = _Facts.of(step)
    return facts.open or facts.not_at or facts.not_aligned


def is_obstacle(name: str) -> bool:
    """Return whether an object's name denotes an obstacle to move over or around."""
    return not _OBSTACLES.isdisjoint(name.split())


def parse_steps(plan: ConditionalPlan) -> tuple[ParsedStep | None, ...]:
    """Parse each step of a plan; a step that cannot be parsed becomes None."""
    task = plan.definition
    facts = [_Facts.of(step) for step in plan.steps]
    marked = [_marked(step.skill, task) for step in plan.steps]
    parsed = _parse(plan, _resolve_it([simplify(text) for text in marked], facts, task), facts)
    # If no step has a motion, a motion may be in the second half of a step: "grab it and pull".
    if all(each is None or each.verb in _NO_MOTION for each in parsed):
        parsed = _parse(plan, _resolve_it([_last_clause(text) for text in marked], facts, task), facts)
    return tuple(
        replace(each, confidence=min(each.confidence, 0.8)) if each and ignored_words(step.skill, task) else each
        for step, each in zip(plan.steps, parsed, strict=True)
    )


def skill_effect(skill: str, task: Task) -> Query | None:
    """Return the state that a skill makes true, such as "the gripper is open"; None if no query expresses that state.

    Example:
        >>> from lw_torchrl import TASKS
        >>> print(skill_effect("move above the puck", TASKS["push"]))
        the robot's gripper is above the puck
    """
    step, text = PlanStep(Query(TRUE), skill), simplify(_marked(skill, task))
    parsed = _StepParser(step, task, text, _Facts.of(step), grasping=True).parse()
    if parsed is None or parsed.moved is None or parsed.confidence < 0.6:
        return None
    if parsed.verb in ("open", "close"):
        return Query((Clause(GRIPPER, "open" if parsed.verb == "open" else "closed"),))
    moved, target = parsed.moved, parsed.target
    by_hand = {"approach": "above", "descend": "near", "reach": "near"}.get(parsed.verb)
    brought = parsed.verb in ("carry", "move") and re.search(rf"\b(?:to|onto|into) <{re.escape(str(target))}>", text)
    if target == GOAL:
        target = next((name for name in task.object_names if is_goal(task, name)), None)
    if parsed.direction or target == moved or not {moved, target} <= {*task.object_names}:
        return None
    if brought or (by_hand and f"<{parsed.target}>" in text):
        return Query((Clause(moved, by_hand or "near", str(target)),))
    return None


def _marked(skill: str, task: Task) -> str:
    """Mark the objects in a skill, and remove forbidden actions; return "" if no certain action remains."""
    text, _, exception = instruction(skill)
    return "" if exception or rests(text) else mark_objects(text, task)


# Match "it" only right after the verb. For "it" elsewhere ("close around it"), the condition identifies the object.
_IT = re.compile(r"^(\w+) (?:it|them|her|him)\b")
_MOVES = f"(?:{'|'.join(sorted((_VERBS['push'] | _VERBS['pull']) - {'close', 'shut'}))})"
_NO_MOTION = {"approach", "beside", "descend", "close", "open"}


def _last_clause(text: str) -> str:
    """Return the last clause of a step, with "it" resolved: "grab <mug> and pull it back" gives "pull <mug> back".

    If the gripper is the object of a motion, the touched object is meant: "turn <gripper> left" gives "turn it left".
    """
    *first, second = re.split(rf" and | to (?={_MOVES} )", text)
    name = next((name for name in re.findall(r"<[^>]*>", "".join(first)) if name != f"<{GRIPPER}>"), "it")
    text = simplify(re.sub(r"\b(?:it|them)\b", name, second, count=1) if first else second)
    text = re.sub(rf"^({_MOVES}) <{GRIPPER}>(.*?)(?: (?:in|into|on|onto|against|to|around))* (<.*)", r"\1 \3\2", text)
    return re.sub(rf"^({_MOVES}) <{GRIPPER}>", r"\1 it", text)


def _parse(plan: ConditionalPlan, texts: list[str], facts: list[_Facts]) -> tuple[ParsedStep | None, ...]:
    task, each = plan.definition, list(zip(plan.steps, texts, facts, strict=True))
    grasping = any(_grasps(text, fact, number == 0) for number, (_, text, fact) in enumerate(each))
    parsed = [_StepParser(step, task, text, fact, grasping).parse() for step, text, fact in each]
    if all(step is None or step.verb in ("approach", "descend", "beside") for step in parsed):
        parsed = [_only_sent(step, text) for step, text in zip(parsed, texts, strict=True)]
    return tuple(_pushed_or_pulled(parsed))


def _resolve_it(texts: Iterable[str], facts: Iterable[_Facts], task: Task) -> list[str]:
    """Replace "it" in "pull it" with the object of the previous step, or with the task's first object."""
    resolved, previous = [], first_object(task)
    for text, fact in zip(texts, facts, strict=True):
        referent = previous or (fact.near[-1] if fact.near else None)
        if referent is not None and (start := _IT.match(text)):
            # In "park it over <mug>" after a step about the mug, "it" is the gripper.
            referent = GRIPPER if f"<{referent}>" in text else referent
            text = f"{start[1]} <{referent}>{text[start.end() :]}"
        resolved.append(text)
        named = (name for name in re.findall(r"<([^>]*)>", text) if name != GRIPPER and not is_goal(task, name))
        previous = next(named, previous)
    return resolved


def _only_sent(step: ParsedStep | None, text: str) -> ParsedStep | None:
    """Parse "move the gripper to the block" as "reach"; only used if every step of the plan just moves the gripper."""
    goes_to = step and step.verb == "descend" and re.match(rf"\w+ <{GRIPPER}> (?:to|at|toward|onto) <", text)
    return replace(step, verb="reach") if step and goes_to else step


def _plain(text: str) -> list[str]:
    """Return the words of a text without the names of objects."""
    return re.sub(r"<[^>]*>", " ", text).split()


def _is_fist(text: str, facts: _Facts, is_first: bool) -> bool:
    """Return whether "close the gripper" makes a fist for pushing: the hand is not yet at an object."""
    is_bare = text.startswith("close ") and "<" not in text.replace(f"<{GRIPPER}>", "")
    return is_bare and (bool(facts.near) or is_first) and not facts.at


def _grasps(text: str, facts: _Facts, is_first: bool) -> bool:
    """Return whether a step grasps or carries an object, or requires the gripper to be closed at an object."""
    verb, *rest = text.split() or [""]
    if not text or _is_fist(text, facts, is_first):
        return False
    if verb in _VERBS["held"] and rest and rest[0].startswith("<") and not text.startswith(f"{verb} <{GRIPPER}>"):
        return True
    return (verb in _VERBS["close"] and (verb != "close" or GRIPPER in text)) or (facts.closed and facts.at)


def _pushed_or_pulled(parsed: Sequence[ParsedStep | None]) -> list[ParsedStep | None]:
    """Choose between push and pull for ambiguous steps: a hand that descends onto an object pulls that object."""
    verbs = {step.verb for step in parsed if step is not None}

    def decided(step: ParsedStep) -> ParsedStep:
        if "beside" in verbs:
            return replace(step, verb="push") if step.verb == "pull" else step
        unsure = step.verb == "push" and step.confidence < 0.6
        return replace(step, verb="pull") if unsure and "descend" in verbs else step

    return [step and decided(step) for step in parsed]


class _StepParser:
    """A parser for one plan step."""

    def __init__(self, step: PlanStep, task: Task, text: str, facts: _Facts, grasping: bool) -> None:
        self.step, self.task, self.text, self.facts, self.grasping = step, task, text, facts, grasping
        text = _PURPOSE.sub("", text)
        self.verb, *rest = _plain(text) or [""]
        self.words = set(rest)
        self.by_hand = re.findall(r"<([^>]*)>", text)[:1] == [GRIPPER]
        starts, text = re.findall(r"<([^>]*)", source_of(text) or ""), without_source(text)
        self.first = first_object(task)
        named = [name for name in re.findall(r"<([^>]+)>", text) if name != GRIPPER]
        self.named = [name for name in named if not is_obstacle(name) or name == self.first]
        # "over the wall" and "around the wall" describe the path, not the target.
        self.obstacle = next((name for name in named if name not in self.named), None)
        self.leaves = any(not self.named or not same_object(task, name, self.named[0]) for name in starts)
        # "move the gripper away from the mug" only names what to leave, so the step has no target.
        self.only_leaves = bool(starts) and not self.named and (self.by_hand or self.verb not in _VERBS["lift"])
        self.tool = match[1] if (match := _TOOL.search(text)) else None
        if self.tool is not None:
            self.named = [name for name in self.named if name != self.tool] or self.named
        self.direction = next((_DIRECTIONS[word] for word in _plain(text)[1:] if word in _DIRECTIONS), None)
        self.near = facts.near[-1] if facts.near else self.first

    def parse(self) -> ParsedStep | None:
        parsed, known = self._parse(), self.verb in _KNOWN
        if parsed is None or (known and self.named):
            return parsed
        if not known and not self.named and not self.by_hand:
            return None
        return replace(parsed, confidence=min(parsed.confidence, 0.8 if known else 0.6))

    def undoes(self) -> bool:
        """Return whether the verb is opposite to the task's ("unlock" in door-lock) or to a known verb ("unshut")."""
        goals, verb = self.task.name.split("-"), self.verb or self.step.skill.split()[0].lower()  # a noun in "lock it"
        stem = verb.removeprefix("un")
        return f"un{verb}" in goals or (stem != verb not in goals and stem in (*goals, *_KNOWN))

    def _parse(self) -> ParsedStep | None:
        if not self.text or self.undoes():
            return None
        if self.first is None:
            elsewhere = self.named and not any(is_goal(self.task, name) for name in whole_objects(self.task))
            target = self.named[-1] if elsewhere else GOAL
            return ParsedStep("hold" if self.verb in _VERBS["hold"] else "reach", GRIPPER, target)
        noun = self.named[0] if self.named else self.near
        if noun is None or _IDLE.fullmatch(self.text) or self.only_leaves:
            return None
        if self.verb in _KNOWN and self.text.startswith(f"{self.verb} <{self.obstacle}>"):  # "push the wall away"
            return None
        if is_goal(self.task, noun) and not self.by_hand and self.verb not in _VERBS["go"]:
            at_goal = self.near is None or is_goal(self.task, self.near)
            noun = self.first if at_goal else object_of(self.task, str(self.near))
        # "open the gripper around the mug" is a descent, not a release.
        opens = self.verb in _VERBS["open"] and GRIPPER in self.text and not self.words & {"around", "onto", "on"}
        if opens or self.verb == "release":
            return ParsedStep("open", GRIPPER, noun)
        if not self.grasping and _is_fist(self.text, self.facts, is_first=True):
            return ParsedStep("approach", GRIPPER, noun, confidence=0.5)
        if self.verb in _VERBS["close"] and (self.verb != "close" or GRIPPER in self.text or self.grasping):
            return self._closed(noun)
        return self._by_hand() if self.by_hand else self._object_moved(noun)

    def _closed(self, noun: str) -> ParsedStep:
        """Parse "grab the mug": descend if the hand is not at the mug, lift if the hand holds the mug, else close."""
        if self.facts.not_at and not self.facts.at and not self.facts.closed:
            return ParsedStep("descend", GRIPPER, noun)
        if self.verb == "pick" and self.facts.closed and not self.facts.open:
            return ParsedStep("move", noun, noun, "up")
        return ParsedStep("close", GRIPPER, noun)

    def _by_hand(self) -> ParsedStep | None:
        """Parse a step that moves the gripper and the object that the gripper holds, if any."""
        target = self.named[-1] if self.named else self.obstacle or self.near
        if target is None or (not self.named and self.words & {"back", "backward", "backwards"}):
            return None
        holds = self.grasping and (self.facts.closed or self.facts.at)
        if is_goal(self.task, target):
            if holds:
                return ParsedStep("carry", self.first, target)
            return ParsedStep("hold" if self.verb in _VERBS["hold"] else "reach", GRIPPER, target)
        # The order matters: the first rule that applies wins.
        above = bool(self.words & _PLACES["above"])
        if self.grasping and self.facts.closed and self.facts.at and (above or "to" in self.words):
            elsewhere = self.near is None or not same_object(self.task, target, self.near)
            elsewhere = elsewhere and target != self.obstacle
            return ParsedStep("carry", self.first, target if elsewhere else GOAL)
        if above or self.verb == "raise" or (not self.named and (self.verb == "lift" or self.direction == "up")):
            return ParsedStep("approach", GRIPPER, target)
        if self.words & (_PLACES["beside"] | {"front", "behind"}):
            side: Direction | None = "away" if "front" in self.words else "toward" if "behind" in self.words else None
            return ParsedStep("beside", GRIPPER, target, side)
        if self.verb == "align":
            return ParsedStep("descend" if self.facts.aligned else "approach", GRIPPER, target)
        down = self.verb in ("lower", "drop") or (self.words & _PLACES["around"] and not self.obstacle)
        far = bool(self.obstacle) or (self.facts.not_aligned and not self.facts.aligned and not self.facts.not_at)
        return ParsedStep("approach" if far and not down else "descend", GRIPPER, target)

    def _object_moved(self, noun: str) -> ParsedStep | None:
        """Parse a step that moves an object."""
        if self.obstacle and not self.named and not self.grasping:  # "move forward over the wall"
            return ParsedStep("approach", GRIPPER, self.obstacle)
        target = self._target(noun)
        if self.leaves and (target is None or target not in self.named):  # "pull the wrench off the peg"
            up = self.direction or "up"
            return ParsedStep("move", noun, noun, up) if self.grasping else ParsedStep("pull", GRIPPER, noun, up)
        if (both := re.search(rf"<{re.escape(noun)}> and <([^>]*)>", self.text)) and self.verb in _VERBS["pull"]:
            noun = both[1]  # "pull <stick> and <thermos>": the stick is the tool
        moved = self.tool if self.tool is not None and (target is None or not is_goal(self.task, target)) else noun
        if target is not None:
            moved = self._compared_point(moved, target)
        lifts, carries = self.verb in _VERBS["lift"], self.verb in _VERBS["carry"]
        direction: Direction | None = self.direction
        if direction == "down" and (self.grasping or self.verb not in ("push", "press")):
            direction = None
        # A plan that grasps moves the held object; any other plan pushes or pulls with the gripper.
        if self.grasping:
            if target is not None:
                carries = carries or bool(self.obstacle or self.words & _PLACES["above"])
                return ParsedStep("carry" if carries else "move", moved, target)
            if lifts or direction is not None:
                return ParsedStep("move", moved, moved, "up" if lifts else direction)
            return ParsedStep("carry" if carries else "move", moved, GOAL, confidence=0.7)
        if lifts and direction is None:
            return ParsedStep("pull", GRIPPER, moved, "up")
        if self.verb == "press" or direction == "down":
            return ParsedStep("push", GRIPPER, moved, direction or "goal")
        if self.verb in _VERBS["pull"] or direction == "toward" or "out" in self.words:
            return ParsedStep("pull", GRIPPER, moved, direction or "goal")
        pushed = self.verb in _VERBS["push"] or direction is not None
        toward = None if direction is not None or target is None or is_goal(self.task, target) else target
        return ParsedStep("push", GRIPPER, moved, direction or "goal", confidence=1.0 if pushed else 0.5, toward=toward)

    def _target(self, noun: str) -> str | None:
        """Return a moved object's target, taken from the step's words or else from the condition's comparisons."""
        if goals := [name for name in self.named if is_goal(self.task, name)]:
            return goals[-1]
        for name in reversed(self.named[1:] if self.tool is None else self.named):
            if not same_object(self.task, name, noun) or self.tool is not None:
                return name
        own, target = self.tool or noun, GOAL if self.obstacle else None
        for first, second in self._pairs():
            is_first, is_second = same_object(self.task, first, own), same_object(self.task, second, own)
            if is_first != is_second:
                other = second if is_first else first
                target = GOAL if is_obstacle(other) else other
        return target

    def _pairs(self) -> list[tuple[str, str]]:
        """Return the pairs of objects that the condition compares, except pairs that are near or around each other."""
        clauses = [c for c in _stated(self.step) if c.negated or c.predicate not in ("near", "around")]
        return [(c.subject, c.object) for c in clauses if c.object is not None and GRIPPER not in (c.subject, c.object)]

    def _compared_point(self, moved: str, target: str) -> str:
        """Return the point on the moved object (e.g. a wrench's ring) that the condition compares to the target."""
        for pair in self._pairs():
            for point, other in (pair, pair[::-1]):
                if same_object(self.task, other, target) and same_object(self.task, point, moved):
                    moved = point
        return moved
