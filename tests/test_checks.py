"""Checks of arguments by their annotations: what passes, and errors that name the argument."""

from __future__ import annotations

import inspect
import json
import math
import pkgutil
import random
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch

import lw_torchrl as lw
from lw_torchrl._util.checks import Count, Natural, Positive, Probability, Scale, check_value, typed, typed_fields
from lw_torchrl._util.files import AnyPath


@typed
def draw(
    points: Count = 1,
    first: Natural = 0,
    size: Scale = 1.0,
    width: Positive = 1.0,
    share: Probability = 0.5,
    number: float = 0.0,
    *,
    filled: bool = False,
    kind: Literal["dot", "line"] = "dot",
    title: str | None = None,
    rows: Sequence[int] = (),
    names: Iterable[str] = (),
    sizes: Mapping[str, Scale] | None = None,
    pair: tuple[int, int] = (0, 0),
    path: tuple[str, ...] = (),
    then: Callable[[int], int] | None = None,
    **others: object,
) -> Iterator[object]:
    return iter([points, size, filled, names])


@pytest.mark.parametrize(
    ("argument", "wrong"),
    [
        ("points", [0, -1, "3", 1.5, 1.0, True, None, math.nan, [1], torch.tensor(1)]),
        ("first", [-1, False]),
        ("size", [-0.1, math.nan, math.inf, "1", True, 10**400, np.array(1.0), np.float16(-1)]),
        ("width", [0, 0.0, -1]),
        ("share", [-0.1, 1.1, math.nan, None]),
        ("number", [math.nan, np.float32(np.nan), 10**400, "0.1", True, 1j]),
        ("filled", [0, 1, "yes", None]),
        ("kind", ["lime", 3, None]),
        ("title", [3, b"title", ["title"]]),
        ("rows", [3, "012", [0] * 99 + [0.5], [True], None]),
        ("names", ["name", 3, ["name", 3]]),
        ("sizes", [3, ["one"], {"one": -1.0}, {"one": 1.0, "two": "2"}, {3: 1.0}]),
        ("pair", [(1,), (1, 2, 3), (1, "2"), [1, 2], 3]),
        ("path", ["one", ["one"], ("one", 2)]),
        ("then", [3, "print"]),
    ],
)
def test_wrong_values_raise_an_error_that_names_the_argument(argument, wrong):
    for value in wrong:
        with pytest.raises((TypeError, ValueError), match=f"^{argument} must be .*, got "):
            draw(**{argument: value})


def test_error_of_a_name_suggests_the_nearest_and_huge_values_are_shortened():
    with pytest.raises(ValueError, match="kind must be 'dot' or 'line', got 'lien'; did you mean 'line'"):
        draw(kind="lien")
    with pytest.raises(TypeError) as raised:
        draw("x" * 10**6)
    assert len(str(raised.value)) < 200


def test_numpy_numbers_arrive_as_python_numbers():
    points, size, filled, _ = draw(np.int64(3), size=np.float32(0.5), filled=np.bool_(True))
    assert (type(points), type(size), type(filled)) == (int, float, bool)
    config = lw.BehavioralCloningConfig(steps=np.int64(3), learning_rate=np.float32(0.5), normalize=np.bool_(True))
    assert json.loads(json.dumps(asdict(config)))["steps"] == 3
    assert lw.data.EpisodeFilter(least_return=np.float16(0.5)).least_return == 0.5


def test_iterators_are_not_consumed_and_random_numbers_not_drawn():
    state = random.getstate()
    *_, names = draw(names=(name for name in "ab"), rows=[*range(100)], colour="red")
    assert list(names) == ["a", "b"]
    assert random.getstate() == state


def test_fields_are_checked_in_instances_of_subclasses_too():
    @typed_fields
    @dataclass(frozen=True)
    class Point:
        x: Scale
        kind: Literal["dot", "line"] = "dot"

    @typed_fields
    @dataclass(frozen=True)
    class Named(Point):
        name: str = ""

    assert Named(np.float32(0.5), name="a") == Named(0.5, "dot", "a")
    for wrong in ({"x": -1}, {"x": 1, "kind": "dott"}, {"x": 1, "name": 3}):
        with pytest.raises((TypeError, ValueError), match=f"^{[*wrong][-1]} must be"):
            Named(**wrong)


def test_checked_value_is_named_as_the_caller_says():
    assert type(check_value("--rows", np.int64(3), Count)) is int
    with pytest.raises(ValueError, match=r"^--rows must be an integer .*, got 0"):
        check_value("--rows", 0, Count)


def test_misspelt_option_is_named():
    with pytest.raises(TypeError, match="'quantile'"):
        lw.PlanConditionedQValue(lw.load_plans("MT10"), quantile=3)


def test_annotations_of_checked_functions_can_be_read():
    """An argument whose type is imported only for type checkers is not checked, so these must be known."""
    modules = [import_module(module.name) for module in pkgutil.walk_packages(lw.__path__, "lw_torchrl.")]
    objects = [one for module in modules for one in vars(module).values()]
    objects += [one.__init__ for one in objects if inspect.isclass(one)]
    checked = [one for one in objects if getattr(one, "__code__", None) is draw.__code__]
    assert len(checked) > 80
    unread = set()
    for function in checked:
        hints = inspect.getclosurevars(function).nonlocals["read_hints"]()
        unread |= {hint for name, hint in function.__annotations__.items() if name not in {*hints, "return"}}
    assert unread <= {"AnyPlans", "Layout", "Layout | None"}


def test_a_home_folder_is_expanded_in_lists_of_paths(monkeypatch):
    monkeypatch.setenv("HOME", "/home/somebody")
    given = ["~/a", Path("~/b"), "c~/d", "~"]
    for hint in (AnyPath | Iterable[AnyPath], Sequence[AnyPath] | None):
        assert check_value("root", given, hint) == ["/home/somebody/a", Path("/home/somebody/b"), "c~/d", "~"]
    assert check_value("names", given[:1], Sequence[str]) == ["~/a"]
