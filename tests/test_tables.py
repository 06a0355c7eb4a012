"""Tables by name: what users add in Python, and what installed packages add by entry points, found when asked for."""

from __future__ import annotations

import sys

import pytest
import torch
from tensordict import TensorDict

import lw_torchrl as lw
from lw_torchrl import _tables
from lw_torchrl._tables import Functions, Table
from lw_torchrl.language.relations import RELATIONS, STATES, Comparison
from lw_torchrl.modules import ENCODERS, EVALUATORS, METHODS, POLICIES, make_policy
from lw_torchrl.suites import SUITES

MODULE = """
import torch
import lw_torchrl as lw
from dataclasses import replace
from lw_torchrl.language.relations import Comparison
from lw_torchrl.modules import DescriptorEncoder

class Unseeing(lw.Policy):
    def __init__(self, tasks, width=8):
        super().__init__()
        self.tasks, self.config = tuple(tasks), {"width": width}
        self.in_keys, self.out_keys = ["observation"], ["action"]
        self.net = torch.nn.Linear(39, 4)
    def prepare(self, tensordict):
        return tuple(self.read(tensordict))
    def act(self, observation):
        return (self.net(observation),)
    def describe(self):
        return super().describe() | {"tasks": list(self.tasks)}
    @classmethod
    def from_description(cls, found, text_encoder=None):
        return cls(found["tasks"], **found["options"])

class Guess(lw.QueryEvaluator):
    def logits(self, observation, task_id):
        return torch.zeros(*task_id.shape, self.plans.num_steps)

class Shouted(DescriptorEncoder):
    pass

FAR = (Comparison("xyz", ">", 0.3),)
LOUD = replace(lw.PLAN_FORMATS["basic_py"], extension="txt")

def make_suite():
    return replace(lw.suites.load_suite("metaworld"), name="metaworld")
"""
POINTS = """
[lw_torchrl.policies]
Unseeing = my_plugin:Unseeing
Broken = no_such_module:Broken
NoClass = my_plugin:FAR
[lw_torchrl.evaluators]
Guess = my_plugin:Guess
[lw_torchrl.encoders]
Shouted = my_plugin:Shouted
[lw_torchrl.relations]
far from = my_plugin:FAR
[lw_torchrl.formats]
loud = my_plugin:LOUD
[lw_torchrl.suites]
again = my_plugin:make_suite
"""
TABLES = (POLICIES, EVALUATORS, ENCODERS, RELATIONS, STATES, lw.PLAN_FORMATS, SUITES, METHODS)


@pytest.fixture
def plugin(tmp_path, monkeypatch):
    """A package that is installed while a test runs."""
    (tmp_path / "my_plugin.py").write_text(MODULE)
    info = tmp_path / "my_plugin-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-plugin\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(POINTS)
    monkeypatch.syspath_prepend(str(tmp_path))
    before = [dict(table.data) for table in TABLES]
    _tables.plugins_of.cache_clear()
    yield tmp_path
    sys.modules.pop("my_plugin", None)
    _tables.plugins_of.cache_clear()
    for table, was in zip(TABLES, before, strict=True):
        table.data, table._broken = was, set()


def test_plugins_are_listed_without_being_imported_and_loaded_by_name(plugin):
    assert "Unseeing" in POLICIES
    assert POLICIES.names()[-3:] == ["Unseeing", "Broken", "NoClass"]
    assert "Unseeing" not in list(POLICIES)
    assert "my_plugin" not in sys.modules
    assert POLICIES["Unseeing"].__name__ == "Unseeing"
    assert "Unseeing" in list(POLICIES)
    assert lw.PLAN_FORMATS["loud"].extension == "txt"
    assert lw.suites.load_suite("again").tasks.keys() == lw.TASKS.keys()
    assert issubclass(EVALUATORS["Guess"], lw.QueryEvaluator)


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("Broken", r"policy 'Broken' is no_such_module:Broken of the package my-plugin.*ModuleNotFoundError"),
        ("NoClass", r"policy 'NoClass' is my_plugin:FAR of the package my-plugin.*must be a class derived from Policy"),
    ],
)
def test_a_plugin_that_cannot_be_loaded_is_named_and_others_work(plugin, name, says):
    with pytest.raises(ImportError, match=says):
        make_policy(name, lw.load_plans("MT10"))
    assert make_policy("Unseeing", lw.load_plans("MT10")).tasks == lw.MT10
    with pytest.raises(ValueError, match=r"method must be one of .*'Unseeing'.*got 'Unseeng'; did you mean 'Unseeing'"):
        make_policy("Unseeng", lw.load_plans("MT10"))


def test_a_plugins_relation_is_known_to_queries_and_one_that_fails_is_a_warning(plugin):
    points = plugin / "my_plugin-1.0.dist-info" / "entry_points.txt"
    points.write_text(points.read_text() + "[lw_torchrl.states]\ngone = my_plugin:NOTHING\n")
    _tables.plugins_of.cache_clear()
    with pytest.warns(UserWarning, match="state 'gone' is my_plugin:NOTHING of the package my-plugin"):
        query = lw.parse_query("the gripper is far from the puck", "push")
    assert str(query) == "the robot's gripper is far from the puck"
    assert RELATIONS["far from"] == (Comparison("xyz", ">", 0.3),)
    with pytest.raises(lw.QueryError):  # and no second warning
        lw.parse_query("the gripper is gone", "push")


def test_an_encoder_and_a_policy_of_plugins_are_kept_in_files(plugin, tmp_path):
    plans = lw.load_plans("MT10")
    for method in ("Unseeing", "Shouted"):
        torch.manual_seed(0)
        actor = make_policy(method, plans)
        lw.save_actor(actor, tmp_path / "policy.zip")
        again = lw.load_actor(tmp_path / "policy.zip")
        assert again.state_dict().keys() == actor.state_dict().keys()
        assert again.tasks == lw.MT10


def test_a_text_stands_for_what_is_imported_later():
    table = Functions("function", "lw_torchrl.none", {"later": "os.path:join", "wrong": "os:path"})
    assert table["later"]("a", "b") == "a/b"
    with pytest.raises(ImportError, match=r"function 'wrong' is os:path, which cannot be loaded .TypeError"):
        table["wrong"]
    with pytest.raises(TypeError, match="function 'number' must be a function"):
        table["number"] = 3
    with pytest.raises(KeyError):
        table["absent"]
    assert table.get("absent") is None
    assert [*table] == table.names() == ["later", "wrong"]
    assert 3 not in table
    del table["wrong"]
    assert "wrong" not in table


def test_a_class_has_its_own_name_in_a_table_that_files_name():
    with pytest.raises(ValueError, match="policy 'mine' must have the name of its class, 'Policy'"):
        POLICIES["mine"] = lw.Policy
    with pytest.raises(TypeError, match="policy 'Tensor' must be a class derived from Policy"):
        POLICIES["Tensor"] = torch.Tensor
    assert isinstance(METHODS, Table)
    with pytest.raises(TypeError, match="method 'mine' must be a Method"):
        METHODS["mine"] = "PlanConditionedActor"


class Careless(lw.Policy):
    """Returns tensors where tuples are wanted."""

    def __init__(self, tasks, given="act"):
        super().__init__()
        self.tasks, self.given = tuple(tasks), given
        self.in_keys, self.out_keys = ["observation"], ["action"]

    def prepare(self, tensordict):
        observation = tensordict["observation"]
        return observation if self.given == "prepare" else (observation,)

    def act(self, observation):
        return {"act": observation[:, :4], "more": (observation, observation)}.get(self.given)


class Headless(lw.Policy):
    def __init__(self, tasks):
        self.tasks = tuple(tasks)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ("act", r"act of Careless must return a tuple of tensors, got a tensor of shape \(2, 4\)"),
        ("prepare", r"prepare of Careless must return a tuple of tensors, got a tensor of shape \(2, 39\)"),
        ("nothing", "act of Careless must return a tuple of tensors, got a NoneType"),
        ("more", "act of Careless must return a tensor for each of out_keys, action, got 2 tensors"),
    ],
)
def test_what_a_policy_returns_is_checked(given, says):
    with pytest.raises((TypeError, ValueError), match=says):
        Careless(["reach"], given)(TensorDict({"observation": torch.zeros(2, 39)}, [2]))


def test_a_policy_that_is_no_module_yet_is_told():
    with pytest.raises(TypeError, match=r"__init__ of Headless must begin with super\(\).__init__\(\)"):
        Headless.for_plans(lw.load_plans("MT10"))
