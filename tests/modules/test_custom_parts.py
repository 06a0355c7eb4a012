"""Custom parts: trained, saved, and loaded in a new process; parts that cannot be saved or used are refused."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from small_actors import action_of, letters, make_actor, make_rows
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from users_parts import Closest, Gated, Pictures, Projection

import lw_torchrl as lw
from lw_torchrl.modules import Concat, MLPDecoder, ObservationFeatures, SkillEncoder

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


def make_batch(rows=16):
    generator = torch.Generator().manual_seed(1)
    batch = make_rows(rows).set("action", torch.rand(rows, 4, generator=generator) - 0.5)
    pixels = torch.randint(256, (rows, 9, 9, 3), generator=generator, dtype=torch.uint8)
    return batch.set("pixels", pixels)


PROGRAM = """
import json, sys
from pathlib import Path
import lw_torchrl as lw
from users_parts import Closest, Gated, Pictures, Projection
from small_actors import letters
from tensordict import load_memmap

rows, actions = load_memmap(sys.argv[1]), {}
for path in map(Path, sys.argv[2:]):
    actor = lw.load_actor(path, text_encoder=letters if "text" in path.stem else None)
    actions[path.stem] = actor(rows.clone())["action"].flatten().tolist()
print(json.dumps(actions))
"""


@pytest.mark.slow
def test_custom_parts_are_trained_saved_and_loaded_in_a_new_process(tmp_path):
    expected, batch = {}, make_batch()
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(len(batch)), batch_size=8)
    replay.extend(batch)
    rows = batch.exclude("action").memmap(tmp_path / "rows")
    config = lw.BehavioralCloningConfig(steps=3, batch_size=8, learning_rate=1e-2)
    for kind in KINDS:
        actor, path = make(kind), tmp_path / f"{kind}.safetensors"
        before = {name: value.clone() for name, value in actor.named_parameters()}
        lw.BehavioralCloningTrainer(actor, replay, config, checkpoint=path, progress=False).train()
        assert all(not torch.equal(value, before[name]) for name, value in actor.named_parameters()), kind
        if kind == "more features":
            assert actor.features.parts[0].mean.any(), "statistics are fitted inside of Concat too"
        expected[kind] = action_of(actor.eval(), rows.clone())
    paths = [str(tmp_path / f"{kind}.safetensors") for kind in KINDS]
    here = Path(__file__).parent
    search = os.pathsep.join([str(here), str(here.parent.parent), *filter(None, [os.environ.get("PYTHONPATH")])])
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(tmp_path / "rows"), *paths],
        capture_output=True, text=True, timeout=240, env={**os.environ, "PYTHONPATH": search},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    loaded = json.loads(done.stdout)
    assert loaded.keys() == expected.keys()
    for kind, action in expected.items():
        torch.testing.assert_close(torch.tensor(loaded[kind]).reshape(len(batch), 4), action, msg=kind)


class Plain(nn.Module):
    def __init__(self):
        super().__init__()
        self.net = nn.LazyLinear(4)

    def forward(self, encoding):
        return self.net(encoding)


@pytest.mark.parametrize(
    ("options", "name", "kind"),
    [
        ({"decoder": Plain()}, "decoder.network", "Plain"),
        ({"skill_encoder": nn.Sequential(nn.LazyLinear(4), Plain())}, "trunk.mixer.encoder.1", "Plain"),
        ({"features": Plain()}, "trunk.features", "Plain"),
    ],
)
def test_error_names_the_part_that_cannot_be_saved(options, name, kind, tmp_path):
    actor = make_actor(**options)
    for save in (lambda: lw.save_actor(actor, tmp_path / "policy.safetensors"), lambda: lw.modules.describe(actor)):
        with pytest.raises(TypeError, match=rf"{name} is a {kind}.*config"):
            save()
    assert not list(tmp_path.iterdir())


def test_assigned_part_is_saved_or_refused(tmp_path):
    path, actor, rows = tmp_path / "policy.safetensors", make_actor(), make_rows(4)
    actor.decoder = Plain()
    with pytest.raises(TypeError, match=r"decoder\.network"):
        lw.save_actor(actor, path)
    actor.decoder = Gated(5)
    lw.save_actor(actor, path)
    assert torch.equal(action_of(lw.load_actor(path), rows), action_of(actor, rows))
    actor.decoder = MLPDecoder(width=4)
    actor.decoder.network._options["width"] = 5  # a config that is not the network's
    with pytest.raises(ValueError, match="description"):
        lw.save_actor(actor, path)


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


def test_class_of_a_script_is_passed_as_parts(tmp_path, monkeypatch):
    path = tmp_path / "policy.safetensors"
    monkeypatch.setattr(Gated, "__module__", "__main__")
    lw.save_actor(make("decoder"), path)
    with pytest.raises(ValueError, match=r"__main__:Gated.*parts=\[Gated\]"):
        lw.load_actor(path)
    assert type(lw.load_actor(path, parts=[Gated]).decoder.network) is Gated


def test_plain_features_state_their_width_so_the_actor_is_saved_and_made_stochastic(tmp_path):
    actor = lw.PlanConditionedActor(PLANS, features=nn.Linear(39, 10))
    assert actor.features.width == 10
    lw.save_actor(actor, tmp_path / "policy.safetensors")
    assert lw.load_actor(tmp_path / "policy.safetensors").stochastic().out_keys[-1] == "action_log_prob"


def test_unsuitable_parts_are_refused():
    actor = lw.PlanConditionedActor(PLANS)
    with pytest.raises(AttributeError, match="no skill_encoder"):
        actor.skill_encoder = nn.Linear(384, 16)
    with pytest.raises(ValueError, match="decoder"):
        lw.PlanConditionedActor(PLANS, decoder=nn.LazyLinear(1))
    decoder = TensorDictModule(nn.Linear(64, 4), ["skill_latent"], ["action"])
    with pytest.raises(ValueError, match="out_keys"):
        lw.PlanConditionedActor(PLANS, decoder=decoder, out_keys=["move"])
    with pytest.raises(ValueError, match="out_keys"):
        actor.in_keys = ["truth", "task_id", "action"]


def test_decoder_that_returns_too_few_tensors_is_refused():
    actor = lw.PlanConditionedActor(PLANS, decoder=nn.LazyLinear(4), out_keys=["loc", "scale"])
    assert list(actor.spec.keys()) == ["action"]
    with pytest.raises(ValueError, match="decoder"):
        actor(qaf=torch.zeros(1, 6), task_id=torch.tensor([lw.task_id("reach")]), observation=torch.rand(1, 39))


def test_task_ids_may_be_a_column():
    actor, ids = lw.PlanConditionedActor(PLANS).eval(), torch.full((2,), lw.task_id("reach"))
    inputs = {"qaf": torch.zeros(2, 6), "observation": torch.rand(2, 39)}
    assert torch.equal(actor(**inputs, task_id=ids)[-1], actor(**inputs, task_id=ids.unsqueeze(-1))[-1])
