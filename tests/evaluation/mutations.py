"""Mutations of JSON values, for tests of functions that read JSON files."""

import copy
from typing import Any

from hypothesis import strategies as st

_NUMBERS = [0, 1, -1, 2, 0.5, -0.0, 1e300, 2**31, 2**63, -(2**63), 10**400]
_LISTS: list[Any] = [[], [[]], [1, 2, 3], ["reach"], ["reach", "reach"], [None], [True], [[[[[[[[]]]]]]]]]
_OTHERS: list[Any] = [None, True, False, "", "5", "reach", "raech", "x" * 5000, {}, {"reach": 1}, {"a": {"b": {}}}]
ODD: list[Any] = [*_NUMBERS, *_LISTS, *_OTHERS]


def places(value: Any, path: tuple = ()) -> list[tuple]:
    """Return the paths of a JSON value and of everything inside it."""
    inside = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path, *(place for key, part in inside for place in places(part, (*path, key)))]


@st.composite
def mutated(draw: st.DrawFn, value: Any) -> Any:
    """Draw a copy of a value with one to three of its parts replaced, removed, repeated or added to."""
    mutant = copy.deepcopy(value)
    for _ in range(draw(st.integers(1, 3))):
        *parents, key = draw(st.sampled_from(places(mutant)[1:] or [("nothing",)]))
        node = mutant
        for name in parents:
            node = node[name]
        if not isinstance(node, (dict, list)) or (isinstance(node, dict) and key not in node):
            continue
        kind = draw(st.sampled_from(["replace", "nudge", "remove", "repeat", "add"]))
        if kind == "replace":
            node[key] = copy.deepcopy(draw(st.sampled_from(ODD)))
        elif (
            kind == "nudge" and type(node[key]) in (int, float) and abs(node[key]) < 10**300
        ):  # the largest float is 1.8e308
            node[key] += draw(st.sampled_from([-1, 1, 0.0, 0.5, 10**9]))
        elif kind == "remove":
            del node[key]
        elif kind == "repeat" and isinstance(node, list):
            node.append(copy.deepcopy(node[key]))
        elif kind == "add" and isinstance(node, dict):
            node["more"] = copy.deepcopy(node[key])
    return mutant
