"""Wrong values for every argument of every public name: a TypeError or a ValueError that names the argument."""

from __future__ import annotations

import ast
import inspect
import math
import re
from importlib import import_module
from typing import Any

import numpy as np
import pytest
import torch
from wrong_values import OF_ONE_NAME, good_calls
from wrong_values import WRONG as OTHERS

import lw_torchrl as lw
from benchmarks.statistics import summarize
from lw_torchrl._util.checks import check_positive, check_probability, check_scale

PUBLIC = {name: import_module(room) for name, room in lw._ROOM_OF.items()}
MORE = {
    "data": ("Behaviour", "add_pictures", "load_pictures"),
    "language.plans": ("PlanStep",),
    "language.nearest": ("nearest_query", "nearest_skill"),
    "language.tasks": ("resolve_tasks",),
    "modules": ("ActorEnsemble", "ImageQueryEvaluator"),
    "objectives": (
        "AdvantageWeightedLoss", "DemonstratedSACLoss", "DemonstratedTD3Loss", "ExpectileValueLoss",
        "standardize_by_task",
    ),
    "record": ("RolloutRecorder",),
    "training": (
        "ImageQueryEvaluatorConfig", "LabelledQueries", "QueryEvaluatorConfig", "QueryEvaluatorTrainer",
        "load_evaluator", "save_evaluator",
    ),
    "transforms": ("CameraTransform", "EnvState", "HideOpening", "JitterTarget", "SwapUnmentioned"),
}  # fmt: skip
PUBLIC |= {name: import_module(f"lw_torchrl.{room}") for room, names in MORE.items() for name in names}
PUBLIC |= {name: lw.modules for name in ("Value", "QValue")}
NOT_MADE_BY_USERS = {"DecodedPlan", "DecodedStep", "PlannerError", "PlanError", "QueryError", "Planner"}
WRONG: dict[str, list[Any]] = {
    "bool": ["no", "yes", "", 1, 0, 1.0, None, [], object],
    "int": ["3", 1.5, math.nan, True, None, [], "many"],
    "float": ["0.1", "", True, None, [], math.nan],
    "str": [3, None, [], b"text", 1.5],
    "AnyPath": [3, None, [], 1.5, True],
    "Count": ["3", 1.5, math.nan, True, None, [], 0, -1],
    "Natural": ["3", 1.5, math.nan, True, None, [], -1],
    "Scale": ["0.1", "", True, None, [], math.nan, math.inf, -0.1],
    "Positive": ["0.1", "", True, None, [], math.nan, math.inf, -0.1, 0.0],
    "Probability": ["0.1", "", True, None, [], math.nan, -0.1, 1.1],
    "Literal": ["no such choice", 3, None, [], True],
}
RIGHT = {"bool": True, "int": 1, "float": 0.5, "str": "reach", "AnyPath": "folder"}


def kind_of(annotation):
    """The row of WRONG for an annotation, and whether None is allowed; None where the annotation is not plain."""
    plain = annotation.removesuffix(" | None") if isinstance(annotation, str) else ""
    kind = "Literal" if re.fullmatch(r"Literal\[[^\[\]]*\]", plain) else plain
    return (kind, annotation != plain) if kind in WRONG else None


def placeholder(annotation):
    kind, _ = kind_of(annotation) or (None, None)
    return ast.literal_eval(f"({annotation[8:-1]},)")[0] if kind == "Literal" else RIGHT.get(kind, object())


def plain_arguments():
    """Each public name's arguments of plain annotations: what to call, the other arguments that it needs, the kind."""
    for name in sorted(PUBLIC):
        public = getattr(PUBLIC[name], name)
        if not callable(public) or name in NOT_MADE_BY_USERS:
            continue
        called = public.__init__ if inspect.isclass(public) else public
        parameters = {key: one for key, one in inspect.signature(called).parameters.items() if key != "self"}
        for argument, parameter in parameters.items():
            if parameter.kind == parameter.VAR_KEYWORD or (found := kind_of(parameter.annotation)) is None:
                continue
            others = {
                key: placeholder(one.annotation)
                for key, one in parameters.items()
                if one.default is one.empty
                and key != argument
                and one.kind not in (one.VAR_KEYWORD, one.VAR_POSITIONAL)
            }
            yield pytest.param(name, argument, others, *found, id=f"{name}.{argument}")


@pytest.mark.parametrize(("name", "argument", "others", "kind", "optional"), list(plain_arguments()))
def test_wrong_values_of_plain_arguments_are_named(calls, name, argument, others, kind, optional):
    for value in WRONG[kind]:
        if value is None and optional:
            continue
        with pytest.raises((TypeError, ValueError), match=argument):
            getattr(PUBLIC[name], name)(**{**calls.get(name, others), argument: value})


@pytest.mark.parametrize("number", [np.float32(0.5), np.float64(0.5), np.int64(1), np.float16(0.5)])
def test_numpys_numbers_are_numbers(number):
    assert check_scale("beta", number) == float(number)
    assert type(check_positive("beta", number)) is type(check_probability("beta", number)) is float
    assert lw.EpisodeFilter(least_return=number).least_return == number


ELSEWHERE = {"EvaluationResult", "PlanStep"}  # the library makes the first, a plan checks its steps
ROOMS = ["envs", "transforms", "modules", "objectives", "data", "training", "evaluation", "planners", "record"]


def other_arguments():
    """Each public name's arguments of other annotations: the name, the argument, wrong values of it."""
    for name in sorted({*PUBLIC} - NOT_MADE_BY_USERS - ELSEWHERE):
        public = getattr(PUBLIC[name], name)
        if not callable(public):
            continue
        called = public.__init__ if inspect.isclass(public) else public
        for argument, one in inspect.signature(called).parameters.items():
            if argument == "self" or one.kind in (one.VAR_KEYWORD, one.VAR_POSITIONAL) or kind_of(one.annotation):
                continue
            plain = one.annotation.removesuffix(" | None")
            values = OF_ONE_NAME.get(f"{name}.{argument}") or OTHERS[plain]
            values = [value for value in values if value is not None or plain == one.annotation]
            yield pytest.param(name, argument, values, id=f"{name}.{argument}")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("arguments")


@pytest.fixture(scope="module")
def calls(folder):
    return good_calls(folder)


@pytest.mark.parametrize(("name", "argument", "values"), list(other_arguments()))
def test_wrong_values_of_other_arguments_are_named_and_leave_no_file(calls, folder, name, argument, values):
    said = {"names": "tasks?"}.get(argument, argument.removesuffix("s"))  # "task must be one of", of one of several
    there = sorted(folder.rglob("*"))
    for value in values:
        with pytest.raises(
            (TypeError, ValueError), match=rf"\b({argument}|{said}|{said.removesuffix('s')})\b"
        ) as raised:
            getattr(PUBLIC[name], name)(**{**calls[name], argument: value})
        assert "unexpected keyword" not in str(raised.value)
    assert sorted(folder.rglob("*")) == there


def room_arguments():
    """Arguments of plain annotations of what the rooms have beside the public names, where they are checked."""
    for room in ROOMS:
        names = import_module(f"lw_torchrl.{room}")
        for name in sorted({*names.__all__} - {*PUBLIC}):
            called = getattr(names, name)
            called = called.__init__ if inspect.isclass(called) else called
            if hasattr(called, "__wrapped__") and inspect.unwrap(called).__module__.startswith("lw_torchrl"):
                yield from ((name, called, argument) for argument in inspect.signature(called).parameters)


@pytest.mark.parametrize(
    ("called", "argument"),
    [pytest.param(called, argument, id=f"{name}.{argument}") for name, called, argument in room_arguments()],
)
def test_wrong_values_of_the_rooms_names_are_named(called, argument):
    parameters = inspect.signature(called).parameters
    if (found := kind_of(parameters[argument].annotation)) is None:
        return
    kind, optional = found
    own = [object()] if "self" in parameters else []
    for value in WRONG[kind]:
        if value is not None or not optional:
            with pytest.raises((TypeError, ValueError), match=rf"\b{argument}\b"):
                called(*own, **{argument: value})


def test_a_folder_that_comes_twice_is_refused(calls, tmp_path):
    root = calls["add_pictures"]["root"]
    link = tmp_path / "link"
    link.symlink_to(root)
    for again in (root, str(root), root / ".." / root.name, link):
        with pytest.raises(ValueError, match=r"root must .* names each folder once"):
            lw.LanguageWorldExperienceReplay([root, again])


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf])
def test_a_column_has_finite_numbers(calls, wrong):
    replay = calls["load_pictures"]["replay"]
    values = torch.zeros(len(replay))
    values[1] = wrong
    with pytest.raises(ValueError, match="must be finite"):
        replay.add_column("own", values)
    assert "own" not in replay.columns


def test_summaries_of_what_is_no_result_or_one_twice(calls):
    result = calls["plot_success"]["result"]
    for results in ([result, result], [lw.load_plans("MT10")], lw.load_plans("MT10"), None, 3):
        with pytest.raises((TypeError, ValueError), match="results"):
            summarize(results)


def test_a_gradient_norm_of_zero_would_train_nothing():
    for config in (lw.BehavioralCloningConfig, lw.OfflineConfig):
        with pytest.raises(ValueError, match="max_grad_norm"):
            config(max_grad_norm=0)
