"""Descriptions of modules as JSON: what they hold, and that they rebuild every kind of module."""

from __future__ import annotations

import json

import pytest
import torch
from small_actors import ACTORS, CANONICAL, PLANS, letters, make_actor, rows_for, small_decoder
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn

import lw_torchrl as lw
from lw_torchrl import modules as m
from lw_torchrl.modules import describe, from_description

MODULES = ACTORS | {
    "attention": lambda: m.PlanAttention(PLANS, in_keys=["truth", ("words", "task")]),
    "mixer": lambda: m.SkillMixer(PLANS, m.SkillEncoder(3)),
    "raw features": lambda: m.ObservationFeatures("raw", 0.2, in_keys=[("robot", "state")]),
    "concatenated features": lambda: m.Concat(m.ObservationFeatures(), m.RoleFeatures(CANONICAL, 0.1), out_keys=["x"]),
    "value": lambda: lw.PlanConditionedValue(PLANS, width=8),
    "evaluator": lambda: lw.StateQueryEvaluator(PLANS, width=8, answers="hard"),
    "transferred": lambda: m.TransferredActor(
        make_actor(CANONICAL, features=m.RoleFeatures(CANONICAL)), CANONICAL, speed=2.0
    ),
}
NOT_SAVED = {"value", "mixed actions"}  # the last has lazy layers


@pytest.mark.parametrize("name", [name for name in MODULES if name not in NOT_SAVED])
def test_it_is_rebuilt_with_the_same_names_and_keys(name):
    module = MODULES[name]()
    again = from_description(json.loads(json.dumps(describe(module))))
    assert type(again) is type(module)
    assert (again.in_keys, again.out_keys) == (module.in_keys, module.out_keys)
    shapes = [{name: value.shape for name, value in each.state_dict().items()} for each in (module, again)]
    assert shapes[0] == shapes[1]
    assert describe(again) == describe(module)


@pytest.mark.parametrize("name", ACTORS)
def test_an_actor_is_saved_and_loaded_to_the_bit(name, tmp_path):
    actor = ACTORS[name]().eval()
    lw.save_actor(actor, tmp_path / "policy.safetensors")
    loaded = lw.load_actor(tmp_path / "policy.safetensors")
    found, expected = (each(rows_for(actor, 6)) for each in (loaded, actor))
    assert (type(loaded), loaded.training) == (type(actor), False)
    assert all(torch.equal(found[key], expected[key]) for key in actor.out_keys)


def test_a_description_says_what_the_actor_is_made_of():
    described = describe(make_actor(decoder=small_decoder(width=9)))
    assert described["class"] == "PlanConditionedActor"
    assert lw.Plans.from_json(described["plans"][0]) == PLANS
    decoder = described["options"]["decoder"]["module"]["options"]["network"]["module"]
    assert (decoder["class"], decoder["options"]["width"]) == ("MLPDecoder", 9)


def test_canonical_plans_keep_their_roles():
    plans = from_description(json.loads(json.dumps(describe(ACTORS["fallback"]())))).plans
    assert plans.has_roles
    assert any(step.role.fallback for step in plans["push"].steps)


def test_keys_are_kept(tmp_path):
    keys = [("words", "qaf"), ("words", "task"), "state"]
    actor = make_actor(in_keys=keys, out_keys=[("agent", "action")])
    lw.save_actor(actor, tmp_path / "policy.safetensors")
    loaded = lw.load_actor(tmp_path / "policy.safetensors")
    assert (loaded.in_keys, loaded.out_keys) == (keys, actor.out_keys)
    assert loaded.out_keys[-1] == ("agent", "action")


def test_sequences_and_layers_of_pytorch_need_no_config():
    layers = nn.Sequential(nn.Linear(39, 8, bias=False), nn.LayerNorm(8), nn.ELU(0.5), nn.Dropout(0.1), nn.Linear(8, 4))
    part = TensorDictModule(layers, in_keys=[("robot", "state")], out_keys=[("other", "action")])
    actor = TensorDictSequential(part, make_actor())
    again = from_description(json.loads(json.dumps(describe(actor))))
    assert (str(again[0]), again.in_keys) == (str(actor[0]), actor.in_keys)
    with pytest.raises(TypeError, match=r"1.0 is a Conv2d, which cannot be saved"):
        describe(nn.Sequential(nn.Linear(3, 3), nn.Sequential(nn.Conv2d(1, 1, 1))))


def test_the_text_encoder_is_passed_to_the_parts():
    actor = make_actor(text_encoder=letters)
    again = from_description(describe(actor), text_encoder=letters)
    assert torch.equal(again.mixer.vectors, actor.mixer.vectors)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: 3, "a description must have class, options and plans, got 3"),
        (lambda d: {**d, "plans": None}, "a description must have class, options and plans"),
        (lambda d: {**d, "class": 3}, "a part must have a class"),
        (lambda d: {**d, "class": "describe"}, "the class 'describe' is not known here"),
        (lambda d: {**d, "class": "os:system"}, "the class 'os:system' is not known here"),
        (lambda d: {**d, "class": "torch.nn:Conv2d"}, "'torch.nn:Conv2d' is not known here"),
        (lambda d: {**d, "options": []}, "options of a PlanConditionedActor must be a table"),
        (lambda d: {**d, "class": "Sequential"}, "parts of a Sequential must be a list or a table"),
        (lambda d: {**d, "options": {**d["options"], "trunk": {"code": "1"}}}, "a value must be a module, plans"),
    ],
)
def test_a_description_that_is_wrong_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        from_description(change(describe(make_actor())))


def test_values_that_are_not_json_are_named():
    actor = make_actor()
    actor.decoder.network._options["width"] = {1, 2}
    with pytest.raises(TypeError, match=r"decoder.network.width must be JSON, plans, a task, a layout or a module"):
        describe(actor)
