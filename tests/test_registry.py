"""Registries: entries that users add in Python, and those that installed packages add by entry points."""

from __future__ import annotations

import sys

import pytest
import torch

import lw_torchrl as lw
from lw_torchrl import _registry
from lw_torchrl._registry import Registry, is_function
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
REGISTRIES = (POLICIES, EVALUATORS, ENCODERS, RELATIONS, STATES, lw.PLAN_FORMATS, SUITES, METHODS)


@pytest.fixture
def plugin(tmp_path, monkeypatch):
    """A package that is installed while a test runs."""
    (tmp_path / "my_plugin.py").write_text(MODULE)
    info = tmp_path / "my_plugin-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-plugin\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(POINTS)
    monkeypatch.syspath_prepend(str(tmp_path))
    before = [dict(registry.data) for registry in REGISTRIES]
    _registry.entry_points_of.cache_clear()
    yield tmp_path
    sys.modules.pop("my_plugin", None)
    _registry.entry_points_of.cache_clear()
    for registry, entries in zip(REGISTRIES, before, strict=True):
        registry.data = entries


def test_plugins_are_listed_without_import_and_loaded_by_name(plugin):
    assert [*POLICIES][-3:] == ["Unseeing", "Broken", "NoClass"]
    assert len(POLICIES) == len([*POLICIES])
    assert "my_plugin" not in sys.modules
    assert POLICIES["Unseeing"].__name__ == "Unseeing"
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


def test_queries_know_the_relation_of_a_plugin(plugin):
    query = lw.parse_query("the gripper is far from the puck", "push")
    assert str(query) == "the robot's gripper is far from the puck"
    assert RELATIONS["far from"] == (Comparison("xyz", ">", 0.3),)


def test_an_encoder_and_a_policy_of_plugins_are_kept_in_files(plugin, tmp_path):
    plans = lw.load_plans("MT10")
    for method in ("Unseeing", "Shouted"):
        torch.manual_seed(0)
        actor = make_policy(method, plans)
        lw.save_actor(actor, tmp_path / "policy.safetensors")
        again = lw.load_actor(tmp_path / "policy.safetensors")
        assert again.state_dict().keys() == actor.state_dict().keys()
        assert again.tasks == lw.MT10


def test_a_string_is_imported_at_its_first_look_up():
    registry = Registry("function", "lw_torchrl.none", {"later": "os.path:join", "wrong": "os:path"}, is_function)
    assert registry["later"]("a", "b") == "a/b"
    with pytest.raises(ImportError, match=r"function 'wrong' is os:path, which cannot be loaded .TypeError"):
        registry["wrong"]
    with pytest.raises(TypeError, match="'number' must be a function"):
        registry["number"] = 3
    with pytest.raises(KeyError, match="function must be one of 'later', 'wrong', got 'latr'; did you mean 'later'"):
        registry["latr"]
    assert registry.get("absent") is None
    del registry["wrong"]
    assert [*registry] == ["later"]


def test_classes_are_registered_by_their_own_name():
    with pytest.raises(ValueError, match="policy 'mine' must have the name of its class, 'Policy'"):
        POLICIES["mine"] = lw.Policy
    with pytest.raises(TypeError, match="policy 'Tensor' must be a class derived from Policy"):
        POLICIES["Tensor"] = torch.Tensor
    with pytest.raises(TypeError, match="method 'mine' must be a Method"):
        METHODS["mine"] = "PlanConditionedActor"
