"""Every argument of every public name: a wrong value is a TypeError or a ValueError that names the argument."""

import inspect
import math
import re
from importlib import import_module
from typing import Any, get_type_hints

import pytest
import torch
from wrong_values import OF_ANY_TYPE, OF_ONE_NAME, good_calls

import lw_torchrl as lw
from benchmarks.statistics import summarize
from lw_torchrl._util.checks import checker

MODULES = [import_module(f"lw_torchrl.{room}") for room in lw._ROOMS if room != "language"]
PUBLIC: dict[str, Any] = {name: getattr(lw, name) for name in lw._ROOM_OF}
PUBLIC |= {name: getattr(module, name) for module in MODULES for name in module.__all__}
PUBLIC |= {one.__name__: one for one in (lw.language.plans.PlanStep, lw.language.tasks.resolve_tasks)}
PUBLIC |= {name: getattr(lw.language.nearest, name) for name in ("nearest_query", "nearest_skill")}
# The library makes results; a plan checks the types of its steps.
NOT_MADE = {"DecodedPlan", "DecodedStep", "EvaluationResult", "Planner", "PlannerError", "PlanError", "QueryError"}
ALSO_NAMED = {"names": ["tasks?"]}
NAMESPACE = {name: value for module in MODULES for name, value in vars(module).items()} | PUBLIC
NAMES = sorted(name for name in {*PUBLIC} - NOT_MADE if callable(PUBLIC[name]))


def function_of(name):
    return PUBLIC[name].__init__ if inspect.isclass(PUBLIC[name]) else PUBLIC[name]


def is_typed(name):
    return "read_hints" in getattr(getattr(function_of(name), "__code__", None), "co_freevars", ())


def arguments_of(name):
    parameters = inspect.signature(function_of(name)).parameters.values()
    several = (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)
    return [one.name for one in parameters if one.name != "self" and one.kind not in several]


def hints_of(name):
    """Return the type hints of a public name's arguments, also of those that its function checks itself."""
    function = function_of(name)
    if not is_typed(name):
        return get_type_hints(function, NAMESPACE | function.__globals__, include_extras=True)
    known = NAMESPACE | vars(lw.language.plans) | inspect.unwrap(function).__globals__
    return get_type_hints(inspect.unwrap(function), known, include_extras=True)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("arguments")


@pytest.fixture(scope="module")
def calls(folder):
    return good_calls(folder)


CASES = [(name, argument) for name in NAMES for argument in arguments_of(name)]
CASES.remove(("resolve_tasks", "tasks"))  # tables, which callers check


@pytest.mark.parametrize(("name", "argument"), CASES, ids=[f"{name}.{argument}" for name, argument in CASES])
def test_wrong_value_raises_an_error_that_names_the_argument_and_leaves_no_file(calls, folder, name, argument):
    if not is_typed(name) and name not in calls:
        assert name not in lw.__all__, "add a good call of it to wrong_values.py"
        return
    allowed = checker(hints_of(name)[argument])
    wrong = [value for value in OF_ANY_TYPE if not allowed(value)]
    if name in calls:
        wrong += OF_ONE_NAME.get(f"{name}.{argument}", OF_ONE_NAME.get(argument, []))
    assert wrong or name not in calls, "add wrong values to OF_ONE_NAME"
    files = sorted(folder.rglob("*"))
    # An error about "reech" in tasks=["reech"] names the task.
    singular = [argument.removesuffix("s"), re.sub("ies$", "y", argument)]
    names = "|".join([argument, *singular, *ALSO_NAMED.get(argument, ())])
    for value in wrong:
        with pytest.raises((TypeError, ValueError), match=rf"\b({names})\b") as raised:
            PUBLIC[name](**{**calls.get(name, {}), argument: value})
        assert not re.search("unexpected keyword|missing .* argument", str(raised.value))
    assert sorted(folder.rglob("*")) == files


def test_same_folder_twice_raises(calls, tmp_path):
    root = calls["add_pictures"]["root"]
    link = tmp_path / "link"
    link.symlink_to(root)
    for again in (root, str(root), root / ".." / root.name, link):
        with pytest.raises(ValueError, match=r"^root "):
            lw.LanguageWorldExperienceReplay([root, again])


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf])
def test_column_must_be_finite(calls, wrong):
    replay = calls["load_pictures"]["replay"]
    values = torch.zeros(len(replay))
    values[1] = wrong
    with pytest.raises(ValueError, match="finite"):
        replay.add_column("own", values)
    assert "own" not in replay.columns


def test_summary_needs_results_of_different_seeds(calls):
    result = calls["plot_success"]["result"]
    for results in ([result, result], [lw.load_plans("MT10")], lw.load_plans("MT10"), None, 3, []):
        with pytest.raises((TypeError, ValueError), match="results"):
            summarize(results)
