"""Convert state machines in JSON and YAML to selectors."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING, Any

from lw_torchrl.language.expressions import TRUE, Expression, all_of, any_of, negate
from lw_torchrl.language.formats.phrases import is_statement, is_told, plain, role_of
from lw_torchrl.language.formats.shapes import mentions, texts_in
from lw_torchrl.language.programs import Branch, Done, Node, Selector, actions_of

if TYPE_CHECKING:
    from lw_torchrl.language.formats.trees import Tree


def transitions_of(value: Any) -> dict[Any, Any]:
    """Return the fields of an object that hold transitions between states."""
    rows = value.items() if isinstance(value, dict) else ()
    return {key: each for key, each in rows if role_of(str(key)) == "transitions"}


def is_machine(members: list[Any], names: Collection[str]) -> bool:
    """Return whether a transition in a table leads to a member of the same table."""
    return any(mentions(value, names) for each in members for value in transitions_of(each).values()) or any(
        text in names and (role_of(key) == "transitions" or is_statement(key)) for key, text in texts_in(members)
    )


def named(value: Any) -> str:
    """Return the name that an object gives itself: {"id": "grasp"}."""
    rows = value.items() if isinstance(value, dict) else ()
    return next((str(each) for key, each in rows if plain(str(key)) in ("id", "name", "key", "state")), "")


def source(value: Any) -> str:
    """Return the name of the state that a transition leaves."""
    if isinstance(value, dict):
        return str(value.get("from", value.get("source", named(value))))
    return str(value[0]) if isinstance(value, list) and value else ""


def machine(tree: Tree, row: dict[Any, Any]) -> Node | None:
    """Convert a state machine to a selector. A later state is active if a condition that leads to it is true and no
    condition that leads back is true. A plan has no memory, so the state that was active before is unknown.
    """
    tables = {str(key): value for key, value in row.items() if isinstance(value, dict | list)}
    outside = [*transitions_of(tables).values()]
    for table in [*tables.values(), row]:
        pairs = table.items() if isinstance(table, dict) else [(named(each), each) for each in table]
        states = {str(name): each for name, each in pairs}
        edges = [value for value in outside if value is not table]
        is_led = any(text in states for _, text in texts_in(edges))
        if len(states) > 1 and (is_led or is_machine([*states.values()], {*states})):
            break
    else:
        return None
    nodes, exits = dict[str, Node | None](), dict[str, list[tuple[Expression, str]]]()
    for name, each in states.items():
        fields = {str(key): value for key, value in (each if isinstance(each, dict) else {"do": each}).items()}
        led = {key for key, value in fields.items() if mentions(value, states) and role_of(key) != "name"}
        until = [tree.condition(value) for key, value in fields.items() if role_of(key) == "until"]
        skipped = led | {key for key in fields if role_of(key) in ("until", "transitions", "name", "comment")}
        nodes[name] = tree.object({key: value for key, value in fields.items() if key not in skipped}, "")
        leading: list[Any] = [{key: value} for key, value in fields.items() if key in led]
        for rows in edges:
            leading.append(rows.get(name) if isinstance(rows, dict) else [x for x in rows if source(x) == name])
        done = all_of(until or [Done(action.text) for action in actions_of(nodes[name])])
        exits[name] = [pair for each in leading for pair in _exits(tree, each, states, done)]
    start = next((str(value) for key, value in row.items() if role_of(str(key)) == "start"), "")
    order = [start if start in states else next(iter(states))]
    for name in order:  # the list grows during the loop
        order += dict.fromkeys(target for _, target in exits[name] if target not in order)
    order += [name for name in states if name not in order]
    parts = list[Node]()
    for place, name in reversed([*enumerate(order)]):
        if (node := nodes[name]) is None:
            continue
        enters = [test for source in order[:place] for test, target in exits[source] if target == name]
        back = [test for test, target in exits[name] if target in order[:place]]
        guard = all_of([any_of(enters), negate(any_of(back))]) if place else TRUE
        parts.append(node if guard == TRUE else Branch(guard, node))
    return Selector(tuple(parts)) if parts else None


def _exits(tree: Tree, value: Any, states: Collection[str], test: Expression) -> list[tuple[Expression, str]]:
    """Return the (condition, name of the next state) pairs of a state."""
    if isinstance(value, str):
        return [(test, value)] if value in states else []
    parts = [*value.items()] if isinstance(value, dict) else []
    parts += [("", each) for each in value] if isinstance(value, list) else []
    parts = [(str(key), each) for key, each in parts if str(key) not in ("from", "source")]
    if isinstance(value, list) and len(value) == 3 and mentions(value[0], states):
        parts = parts[1:]  # [state, condition, next state]
    targets = [each for key, each in parts if isinstance(each, str) and each in states and role_of(key) != "name"]
    others = [each for _, each in parts if isinstance(each, str | dict | list) and each not in targets]
    if len(targets) == 1 and others and not any(mentions(each, states) for each in others):
        return [(all_of(map(tree.condition, others)), targets[0])]
    pairs = list[tuple[Expression, str]]()
    for key, each in parts:
        if key in states:
            pairs.append((tree.condition(each), key))
        else:
            pairs += _exits(tree, each, states, tree.said(key) if is_told(key) else test)
    return pairs
