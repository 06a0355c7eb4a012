"""Checks of arguments by their annotations: errors name the argument, what was given and what is allowed."""

from __future__ import annotations

import dataclasses
import inspect
import json
import math
from typing import Literal

import numpy as np
import pytest

import lw_torchrl as lw
from lw_torchrl._util.checks import Count, Probability, Scale, check_fields, check_scale, checked


@checked
def draw(
    points: Count, filled: bool = False, kind: Literal["dot", "line"] = "dot", *, share: Probability = 0.5,
    size: Scale | None = None, **others: object,
) -> int:  # fmt: skip
    return points


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"points": 0}, ValueError, "points must be at least 1, got 0"),
        ({"points": "3"}, TypeError, "points must be an integer, got '3'"),
        ({"filled": 1}, TypeError, "filled must be True or False, got 1"),
        ({"kind": "lien"}, ValueError, "kind must be one of 'dot', 'line', got 'lien'; did you mean 'line'"),
        ({"share": 1.1}, ValueError, "share must be from 0 to 1, got 1.1"),
        ({"size": math.inf}, ValueError, "size must be finite and at least 0, got inf"),
        ({"size": math.nan}, ValueError, "size must be finite, got nan"),
    ],
)
def test_a_wrong_argument_is_named_with_what_is_allowed(arguments, error, message):
    assert draw(np.int64(3), size=None, colour="red") == 3
    with pytest.raises(error, match=message):
        draw(**{"points": 3, **arguments})


def test_numpy_numbers_are_numbers():
    assert type(check_scale("beta", np.float32(0.5))) is float
    assert lw.EpisodeFilter(least_return=np.float16(0.5)).least_return == 0.5


def test_a_misspelt_option_that_is_passed_on_is_named_with_the_nearest():
    with pytest.raises(TypeError, match="did you mean 'quantiles'"):
        lw.PlanConditionedQValue(lw.load_plans("MT10"), quantile=3)


def test_help_shows_the_options_that_are_passed_on():
    shown = inspect.signature(lw.PlanConditionedQValue).parameters
    assert {"width", "depth", "ensemble", "quantiles"} <= {*shown}
    assert not any(one.kind is one.VAR_KEYWORD for one in shown.values())


def test_fields_are_checked_however_their_annotations_are_kept():
    made = dataclasses.make_dataclass("Made", [("steps", int), ("rate", "float"), ("kind", Literal["l1", "l2"])])
    check_fields(made(3, 0.1, "l1"))
    for wrong, name in ((made("3", 0.1, "l1"), "steps"), (made(3, "x", "l1"), "rate"), (made(3, 0.1, "l3"), "kind")):
        with pytest.raises((TypeError, ValueError), match=name):
            check_fields(wrong)


def test_numbers_of_numpy_become_plain_ones():
    """JSON, to which configurations are written, has no others."""
    config = lw.BehavioralCloningConfig(steps=np.int64(3), learning_rate=np.float32(0.5), normalize=np.bool_(True))
    assert json.loads(json.dumps(dataclasses.asdict(config)))["steps"] == 3

    @checked
    def numbers(count: int, scale: float, flag: bool = False) -> tuple[type, ...]:
        return type(count), type(scale), type(flag)

    assert numbers(np.int64(1), np.float32(0.5), flag=np.bool_(True)) == (int, float, bool)
