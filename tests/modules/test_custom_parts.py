"""Custom parts: trained, saved and loaded; parts that cannot be saved or used are refused."""

import sys

import pytest
import torch
from small_actors import action_of, letters, make_actor, make_rows
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from users_parts import Closest, Gated, Pictures, Projection

import lw_torchrl as lw
from lw_torchrl.modules import Concat, ObservationFeatures, SkillEncoder

PLANS = lw.load_plans("MT10")

KINDS = {
    "decoder": lambda: {"decoder": Gated(6)},
    "decoder that reads the observation": lambda: {"decoder": Closest()},
    "decoder of PyTorch's layers": lambda: {"decoder": nn.Sequential(nn.Linear(62, 8), nn.GELU(), nn.Linear(8, 4))},
    "skill encoder": lambda: {"skill_encoder": Projection(5)},
    "features": lambda: {"features": Pictures(3)},
    "more features": lambda: {"features": Concat(ObservationFeatures(), Pictures(3))},
    "text encoder": lambda: {"text_encoder": letters, "skill_encoder": SkillEncoder(3)},
}


def make(kind):
    return make_actor(**KINDS[kind]())


@pytest.mark.parametrize("kind", KINDS)
def test_custom_part_is_trained_saved_and_loaded(kind, tmp_path):
    path, actor = tmp_path / "policy.safetensors", make(kind)
    batch = make_rows(16).set("action", torch.rand(16, 4) - 0.5)
    batch["pixels"] = torch.randint(256, (16, 9, 9, 3), dtype=torch.uint8)
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(len(batch)), batch_size=8)
    replay.extend(batch)
    before = {name: value.clone() for name, value in actor.named_parameters()}
    config = lw.BehavioralCloningConfig(steps=3, batch_size=8, learning_rate=1e-2)
    lw.BehavioralCloningTrainer(actor, replay, config, checkpoint=path, progress=False).train()
    assert all(not torch.equal(value, before[name]) for name, value in actor.named_parameters())
    if kind == "more features":
        assert actor.features.parts[0].mean.any(), "statistics are fitted inside of Concat too"
    loaded = lw.load_actor(path, text_encoder=letters if kind == "text encoder" else None)
    assert torch.equal(action_of(loaded, batch), action_of(actor.eval(), batch))


class Plain(nn.LazyLinear):
    cls_to_become = None


UNSAVED = {
    "decoder.network": lambda: {"decoder": Plain(4)},
    "trunk.mixer.encoder.1": lambda: {"skill_encoder": nn.Sequential(nn.LazyLinear(4), Plain(4))},
    "trunk.features": lambda: {"features": Plain(4)},
}


@pytest.mark.parametrize("name", UNSAVED)
def test_error_names_the_part_that_cannot_be_saved(name, tmp_path):
    actor = make_actor(**UNSAVED[name]())
    for save in (lambda: lw.save_actor(actor, tmp_path / "policy.safetensors"), lambda: lw.modules.describe(actor)):
        with pytest.raises(TypeError, match=rf"{name} cannot be saved: give Plain an attribute config"):
            save()
    assert not list(tmp_path.iterdir())


def test_loading_never_imports_a_module_that_a_file_names(tmp_path, monkeypatch):
    path = tmp_path / "policy.safetensors"
    lw.save_actor(make("decoder"), path)
    monkeypatch.delitem(sys.modules, "users_parts")
    with pytest.raises(ValueError, match=r"users_parts:Gated.*import users_parts.*parts=\[Gated\]"):
        lw.load_actor(path)
    assert "users_parts" not in sys.modules
    rows = make_rows(4)
    assert type(lw.load_actor(path, parts=[Gated]).decoder.network) is Gated
    assert action_of(lw.load_actor(path, parts=[Gated]), rows).shape == (4, 4)


def test_plain_features_state_their_width_so_the_actor_is_saved_and_made_stochastic(tmp_path):
    actor = lw.PlanConditionedActor(PLANS, features=nn.Linear(39, 10))
    assert actor.features.width == 10
    lw.save_actor(actor, tmp_path / "policy.safetensors")
    assert lw.load_actor(tmp_path / "policy.safetensors").stochastic().out_keys[-1] == "action_log_prob"
