"""Descriptions of modules as JSON, from which every kind of module is rebuilt."""

import json

import pytest
import torch
from small_actors import ACTORS, CANONICAL, PLANS, letters, make_actor, make_role_actor, rows_for
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
    "evaluator": lambda: lw.modules.StateQueryEvaluator(PLANS, width=8, answers="hard"),
    "transferred": lambda: m.TransferredActor(make_role_actor(), CANONICAL, speed=2.0),
}


@pytest.mark.parametrize("name", MODULES)
def test_rebuilt_module_has_the_same_names_and_keys(name):
    module = MODULES[name]()
    again = from_description(json.loads(json.dumps(describe(module))))
    assert type(again) is type(module)
    assert (again.in_keys, again.out_keys) == (module.in_keys, module.out_keys)
    shapes = [{name: value.shape for name, value in each.state_dict().items()} for each in (module, again)]
    assert shapes[0] == shapes[1]
    assert describe(again) == describe(module)


@pytest.mark.parametrize("name", [*ACTORS, "transferred"])
def test_saved_and_loaded_actor_gives_the_same_bits(name, tmp_path):
    actor = MODULES[name]().eval()
    lw.save_actor(actor, tmp_path / "policy.safetensors")
    loaded = lw.load_actor(tmp_path / "policy.safetensors")
    output, expected = (each(rows_for(actor, 6)) for each in (loaded, actor))
    assert (type(loaded), loaded.training) == (type(actor), False)
    assert all(torch.equal(output[key], expected[key]) for key in actor.out_keys)


def test_pytorch_layers_and_sequences_need_no_config():
    layers = nn.Sequential(nn.Linear(39, 8, bias=False), nn.LayerNorm(8), nn.ELU(0.5), nn.Dropout(0.1), nn.Linear(8, 4))
    part = TensorDictModule(layers, in_keys=[("robot", "state")], out_keys=[("other", "action")])
    actor = TensorDictSequential(part, make_actor())
    again = from_description(json.loads(json.dumps(describe(actor))))
    assert (str(again[0]), again.in_keys) == (str(actor[0]), actor.in_keys)
    with pytest.raises(TypeError, match=r"1\.0 cannot be saved: give Conv2d"):
        describe(nn.Sequential(nn.Linear(3, 3), nn.Sequential(nn.Conv2d(1, 1, 1))))


def test_text_encoder_is_passed_to_the_parts_and_a_later_setting_is_kept():
    actor = make_actor(text_encoder=letters)
    actor.decoder.network.squash = False
    again = from_description(describe(actor), text_encoder=letters)
    assert torch.equal(again.mixer.vectors, actor.mixer.vectors)
    assert again.decoder.network.squash is False
