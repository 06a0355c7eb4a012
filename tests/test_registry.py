"""Registries: entries that users add in Python, and those that installed packages add by entry points."""

import copy
import importlib
import pickle
import sys
from pathlib import Path

import pytest
from tensordict.nn import TensorDictSequential

import lw_torchrl as lw
from lw_torchrl._util import registry as _registry
from lw_torchrl._util.registry import Registry, is_function
from lw_torchrl.language.relations import RELATIONS, STATES, Comparison
from lw_torchrl.modules import METHODS, make_policy
from lw_torchrl.suites import SUITES

REGISTRIES = (RELATIONS, STATES, lw.PLAN_FORMATS, SUITES, METHODS)


@pytest.fixture
def plugin(monkeypatch):
    """A package that is installed while a test runs."""
    monkeypatch.syspath_prepend(str(Path(__file__).with_name("plugin")))
    before = [dict(registry.data) for registry in REGISTRIES]
    _registry.entry_points_of.cache_clear()
    yield
    sys.modules.pop("my_plugin", None)
    _registry.entry_points_of.cache_clear()
    for registry, entries in zip(REGISTRIES, before, strict=True):
        registry.data = entries


def test_plugins_are_listed_without_import_and_loaded_by_name(plugin):
    assert [*METHODS][-3:] == ["mine", "broken", "uncallable"]
    assert len(METHODS) == len([*METHODS])
    assert "my_plugin" not in sys.modules
    assert METHODS["mine"].__name__ == "make"
    assert lw.PLAN_FORMATS["loud"].extension == "txt"
    assert lw.suites.load_suite("again").tasks.keys() == lw.TASKS.keys()


def test_broken_plugin_is_named_and_others_work(plugin):
    plans = lw.load_plans("MT10")
    with pytest.raises(ImportError, match=r"'broken' .no_such_module:broken from the package my-plugin.*ModuleNot"):
        make_policy("broken", plans)
    with pytest.raises(ImportError, match=r"method 'uncallable' .my_plugin:FAR .*must be a function"):
        make_policy("uncallable", plans)
    assert make_policy("mine", plans, width=3).decoder.network.config["width"] == 3
    with pytest.raises(ValueError, match=r"method must be one of .*'mine'.*got 'mien'; did you mean 'mine'"):
        make_policy("mien", plans)


def test_queries_use_a_plugins_relation(plugin):
    query = lw.parse_query("the gripper is far from the puck", "push")
    assert str(query) == "the robot's gripper is far from the puck"
    assert RELATIONS["far from"] == (Comparison("xyz", ">", 0.3),)


def test_missing_relation_of_a_policy_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(RELATIONS, "beside", (Comparison("xyz", "<", 0.05),))
    plan = lw.ConditionalPlan.from_pairs("push", [("the gripper is beside the puck", "close the gripper")])
    lw.save_actor(lw.PlanConditionedActor(lw.Plans([plan])), tmp_path / "policy.safetensors")
    monkeypatch.delitem(RELATIONS, "beside")
    with pytest.raises(ValueError, match=r"'beside'.*; import the module that registers your relations first"):
        lw.load_actor(tmp_path / "policy.safetensors")


def test_plugins_evaluator_is_loaded(plugin, tmp_path):
    plans = lw.load_plans("MT10")
    guess = importlib.import_module("my_plugin").Guess
    actor = TensorDictSequential(guess(plans), make_policy("mine", plans))
    lw.save_actor(actor, tmp_path / "policy.safetensors")
    assert type(lw.load_actor(tmp_path / "policy.safetensors")[0]) is guess
    del sys.modules["my_plugin"]
    with pytest.raises(ValueError, match=r"'my_plugin:Guess' is unknown: import my_plugin first"):
        lw.load_actor(tmp_path / "policy.safetensors")
    assert "my_plugin" not in sys.modules


def test_string_is_imported_at_its_first_use():
    registry = Registry("function", "lw_torchrl.none", {"later": "os.path:join", "wrong": "os:path"}, is_function)
    assert registry["later"]("a", "b") == "a/b"
    with pytest.raises(ImportError, match=r"function 'wrong' .os:path. cannot be loaded .ArgumentError"):
        registry["wrong"]
    with pytest.raises(TypeError, match="'number' must be a function"):
        registry["number"] = 3
    with pytest.raises(KeyError, match="function must be one of 'later', 'wrong', got 'latr'; did you mean 'later'"):
        registry["latr"]
    assert registry.get("absent") is None
    del registry["wrong"]
    assert [*registry] == ["later"]


PUBLIC_TABLES = [
    lw.TASKS, lw.PLAN_FORMATS, SUITES, METHODS, STATES, RELATIONS, lw.data.REWARDS, lw.data.BEHAVIOURS,
    lw.load_skills(), lw.load_plans("MT10"),
]  # fmt: skip


@pytest.mark.parametrize("table", PUBLIC_TABLES, ids=lambda table: type(next(iter(table.values()))).__name__)
@pytest.mark.parametrize("duplicate", [lambda table: pickle.loads(pickle.dumps(table)), copy.copy, copy.deepcopy])
def test_public_tables_can_be_pickled_and_copied(table, duplicate):
    other = duplicate(table)
    assert type(other) is type(table)
    assert other == table
