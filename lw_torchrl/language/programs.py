"""Programs: a plan's control flow as a tree, and the compiler that turns the tree into guarded actions.

The readers of :mod:`lw_torchrl.language.formats` build trees from Python, JSON, YAML and prose.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import TypeAlias

from lw_torchrl.language.expressions import FALSE, TRUE, Expression, all_of, any_of, leaves, negate, once

MOST_DEPTH = 60  # maximum nesting of a program, without counting ``elif``
_BREAK = "break"


class ProgramError(ValueError):
    """The error for a program that is too deep or too large to compile."""


@dataclass(frozen=True)
class Action:
    """A skill to carry out."""

    text: str  # "move above the puck"
    line: int = 1  # line number in the text, from 1
    goal: str = ""  # the state to reach, as written


@dataclass(frozen=True)
class Check:
    """A step that succeeds while a condition is true, and fails otherwise."""

    condition: Expression


@dataclass(frozen=True)
class Branch:
    """A choice between two programs. The branch fails if its condition is false and it has no second program."""

    condition: Expression
    then: Node
    otherwise: Node | None = None


@dataclass(frozen=True)
class Sequence:
    """A sequence of programs. Each runs once all previous ones succeed; if one fails, the sequence fails.

    With ``memory``, a program that has succeeded while it was active is not run again in the episode.
    """

    parts: tuple[Node, ...] = ()
    memory: bool = False


@dataclass(frozen=True)
class Block:
    """A block of code. Branches and loops run concurrently; each action waits until all parts above are done."""

    parts: tuple[Node, ...] = ()


@dataclass(frozen=True)
class Selector:
    """Alternatives: each runs if all previous ones fail.

    If some alternatives are conditions, the others run until one of these conditions is true.
    """

    parts: tuple[Node, ...] = ()


@dataclass(frozen=True)
class Loop:
    """A loop that runs a program while a condition is true. Later parts wait until the condition is false."""

    condition: Expression
    body: Node


@dataclass(frozen=True)
class Jump:
    """The end of the program for this control step, or a jump to a later :class:`Label`."""

    label: str = ""  # "" for the end, "break" for the end of the innermost loop


@dataclass(frozen=True)
class Label:
    """The place in a sequence where a :class:`Jump` continues."""

    name: str


@dataclass(frozen=True)
class Done:
    """A leaf of a condition. The leaf is true once an action has taken effect."""

    text: str  # the action's text


Node: TypeAlias = Action | Check | Branch | Sequence | Block | Selector | Loop | Jump | Label


@dataclass
class _Flow:
    """The conditions under which control leaves a program, given that the program's guard is true."""

    falls: Expression = TRUE  # control would reach the end if actions took no time
    settles: Expression = TRUE  # control reaches the end, and all actions are done
    fails: Expression = FALSE
    jumps: dict[str, Expression] = field(default_factory=dict)  # label to the condition of a jump to it


@dataclass(frozen=True)
class Guarded:
    """An action, and the condition under which it is active."""

    guard: Expression
    action: Action


def compile_program(
    program: Node,
    effect: Callable[[str], str | None] = lambda text: None,
    known: Callable[[str], bool] = lambda text: True,
    is_done: Callable[[Expression, str], bool] = lambda guard, effect: False,
) -> list[Guarded]:
    """Compile a program into guarded actions, for a policy that evaluates all guards at each control step.

    An action's guard is the conjunction of the conditions on the path to it. In a sequence, an action also waits for
    the effect of the previous action; if no condition expresses that effect, both actions are active.

    Args:
        effect: returns the condition that an action makes true ("the gripper is open"), or None if there is none.
        known: returns whether a condition can be evaluated; a loop with an unknown condition always runs.
        is_done: returns whether a guard implies an effect. An action whose guard implies its effect is treated
            as an action without an effect.

    Raises:
        ProgramError: the program nests more than 60 levels deep, or a condition joins more than 1,000 parts.

    Example:
        >>> near, far = Action("close the gripper"), Action("move to the puck")
        >>> for step in compile_program(Branch(any_of(["near", "held"]), near, far)):
        ...     print(step.guard, "->", step.action.text)
        near or held -> close the gripper
        not near and not held -> move to the puck
    """
    compiler = _Compiler(effect, known, is_done)
    try:
        compiler.run(program, TRUE, False, 0)
    except ProgramError:
        raise
    except ValueError as error:
        raise ProgramError(str(error)) from error
    return compiler.steps


def choose(condition: Expression, then: Expression, otherwise: Expression) -> Expression:
    """Return "``then`` if ``condition`` else ``otherwise``" as a short expression."""
    if then == otherwise:
        return then
    if then == TRUE or otherwise == TRUE:
        return any_of([condition, otherwise]) if then == TRUE else any_of([negate(condition), then])
    return any_of([all_of([condition, then]), all_of([negate(condition), otherwise])])


def actions_of(program: Node | None) -> Iterator[Action]:
    """Yield the actions of a program, in the order of the text."""
    stack = [program]
    while stack:
        each = stack.pop()
        if isinstance(each, Action):
            yield each
        elif isinstance(each, Branch):
            stack += [each.otherwise, each.then]
        elif isinstance(each, Loop):
            stack.append(each.body)
        elif isinstance(each, Sequence | Block | Selector):
            stack += reversed(each.parts)


def is_condition(node: Node) -> bool:
    """Return whether a program consists of conditions only."""
    if isinstance(node, Sequence | Selector):
        return all(map(is_condition, node.parts))
    return isinstance(node, Check)


def tidy(guard: Expression) -> Expression:
    """Drop alternatives that contradict the rest of a conjunction: "a and (not a or b)" becomes "a and b".

    Example:
        >>> print(tidy(all_of(["a", any_of([negate("a"), "b"])])))
        a and b
    """
    before = None
    while guard.kind == "all" and guard != before:
        excluded = {negate(part) for part in guard.parts if part.kind == "leaf"}
        parts = [
            any_of(each for each in part.parts if excluded.isdisjoint(each.parts if each.kind == "all" else (each,)))
            if part.kind == "any"
            else part
            for part in guard.parts
        ]
        before, guard = guard, all_of(parts)
    return guard


class _Compiler:
    def __init__(
        self,
        effect: Callable[[str], str | None],
        known: Callable[[str], bool],
        is_done: Callable[[Expression, str], bool],
    ) -> None:
        self.effect, self.known, self.is_done, self.steps = effect, known, is_done, list[Guarded]()

    def run(self, node: Node, here: Expression, followed: bool, depth: int) -> _Flow:
        """Append the guarded actions of a program with the guard ``here``.

        If the program is ``followed`` by another one, the last action stops as soon as its effect is reached.
        """
        if depth > MOST_DEPTH:
            raise ProgramError(f"a program must nest at most {MOST_DEPTH} levels deep; split it into consecutive steps")
        if isinstance(node, Action):
            return self.action(node, here, followed)
        if isinstance(node, Check):
            return _Flow(settles=node.condition, fails=negate(node.condition))
        if isinstance(node, Jump):
            return _Flow(falls=FALSE, settles=FALSE, jumps={node.label: TRUE} if node.label else {})
        if isinstance(node, Branch):
            return self.branch(node, here, followed, depth + 1)
        if isinstance(node, Loop):
            return self.loop(node, here, depth + 1)
        if isinstance(node, Selector):
            return self.selector(node, here, followed, depth + 1)
        if isinstance(node, Sequence) and node.memory:
            return self.remembered(node, here, depth + 1)
        if isinstance(node, Sequence | Block):
            return self.sequence(node, here, followed, depth + 1)
        return _Flow()

    def action(self, node: Action, here: Expression, followed: bool) -> _Flow:
        effect = self.effect(node.text)
        if effect is not None and followed and self.is_done(here, effect):
            effect = None
        done = TRUE if effect is None else all_of([effect])
        guard = all_of([here, negate(done)]) if followed and effect is not None else here
        self.steps.append(Guarded(guard, node))
        return _Flow(settles=done)

    def branch(self, node: Branch, here: Expression, followed: bool, depth: int) -> _Flow:
        conditions, flows = list[Expression](), list[_Flow]()
        last: Node | None = node
        while isinstance(last, Branch):  # a loop, since a chain of ``elif`` may be long
            flows.append(self.run(last.then, all_of([here, last.condition]), followed, depth))
            here = all_of([here, negate(last.condition)])
            conditions.append(last.condition)
            last = last.otherwise
        flow = _Flow(fails=TRUE) if last is None else self.run(last, here, followed, depth)
        for condition, then in zip(reversed(conditions), reversed(flows), strict=True):
            flow = _Flow(
                choose(condition, then.falls, flow.falls),
                choose(condition, then.settles, flow.settles),
                choose(condition, then.fails, flow.fails),
                {
                    label: choose(condition, then.jumps.get(label, FALSE), flow.jumps.get(label, FALSE))
                    for label in {**then.jumps, **flow.jumps}
                },
            )
        return flow

    def loop(self, node: Loop, here: Expression, depth: int) -> _Flow:
        known = all(map(self.known, leaves(node.condition)))
        condition = node.condition if known else TRUE
        flow = self.run(node.body, all_of([here, condition]), False, depth)
        ends = any_of([negate(condition), flow.jumps.pop(_BREAK, FALSE)])
        if not known:
            ends = flow.settles
        return _Flow(ends, ends, jumps={label: all_of([condition, jump]) for label, jump in flow.jumps.items()})

    def selector(self, node: Selector, here: Expression, followed: bool, depth: int) -> _Flow:
        reached, successes, flows = TRUE, list[Expression](), list[_Flow]()
        has_conditions = any(map(is_condition, node.parts))
        for part in node.parts:
            flow = self.run(part, all_of([here, reached]), followed and not has_conditions, depth)
            if is_condition(part) or not has_conditions:
                before = [other.fails for other, node in zip(flows, node.parts, strict=False) if not is_condition(node)]
                successes.append(all_of([*before, flow.settles]))
            reached = all_of([reached, flow.fails])
            flows.append(flow)
        return _Flow(settles=any_of(successes), fails=reached)

    def sequence(self, node: Sequence | Block, here: Expression, followed: bool, depth: int) -> _Flow:
        parts = _inlined(node)
        last_wait = max((k for k, part in enumerate(parts) if not isinstance(part, Jump | Label)), default=-1)
        last_action = max((k for k, part in enumerate(parts) if isinstance(part, Action)), default=-1)
        last_end = max((k for k, part in enumerate(parts) if isinstance(part, Jump) and not part.label), default=-1)
        # hard: the condition for all later parts; soft: the additional condition for later actions; done: the condition
        # under which the previous parts have succeeded, apart from checks.
        hard, soft, done, falls, fails, jumps = TRUE, TRUE, TRUE, TRUE, list[Expression](), dict[str, Expression]()
        for number, part in enumerate(parts):
            if isinstance(part, Label):
                jump = jumps.pop(part.name, FALSE)
                hard, soft = any_of([all_of([hard, soft]), jump]), TRUE
                falls = any_of([falls, jump])
                continue
            is_action, beside = isinstance(part, Action), isinstance(node, Block) and isinstance(part, Branch)
            guard = all_of([here, hard, soft] if is_action or not isinstance(node, Block) else [here, hard])
            is_followed = (last_action if beside else last_wait) > number
            stops = (followed and last_end < number) or is_followed
            flow = self.run(part, guard, stops, depth)
            fails.append(all_of([done, flow.fails]))
            for label, condition in flow.jumps.items():
                jumps[label] = any_of([jumps.get(label, FALSE), all_of([hard, soft, condition])])
            hard = all_of([hard, flow.falls])
            if beside:
                soft = all_of([soft, flow.settles])
            else:
                hard = all_of([hard, flow.settles])
            done = done if isinstance(part, Check) else all_of([done, flow.settles])
            falls = all_of([falls, flow.falls])
        return _Flow(falls, all_of([hard, soft]), any_of(fails), jumps)

    def remembered(self, node: Sequence, here: Expression, depth: int) -> _Flow:
        done, falls, fails = TRUE, TRUE, list[Expression]()
        for part in node.parts:
            begin = len(self.steps)
            flow = self.run(part, all_of([here, done]), not isinstance(part, Action), depth)
            before, done = done, once(all_of([here, done, flow.settles]))
            fails.append(all_of([before, negate(done), flow.fails]))
            falls = all_of([falls, flow.falls])
            if flow.settles != TRUE:  # otherwise no effect of the last action is known, so the action stays active
                for number, step in enumerate(self.steps[begin:], begin):
                    self.steps[number] = replace(step, guard=all_of([step.guard, negate(done)]))
        return _Flow(falls, done, any_of(fails))


def _inlined(node: Sequence | Block) -> list[Node]:
    """Return the parts of a sequence, with nested sequences flattened."""
    parts = list[Node]()
    for part in node.parts:
        is_same = type(part) is type(node) and not (isinstance(part, Sequence) and part.memory)
        parts += _inlined(part) if is_same else [part]  # type: ignore[arg-type]
    return parts
