"""Policy files that are other archives, damaged or planted with pickles: none runs code or is unpacked."""

from __future__ import annotations

import io
import json
import pickle
import resource
import struct
import zipfile

import pytest
import torch
from hostile_files import PLANS, SMALL, Evil, make_trainer, parts, rebuild, refuses, train_good
from tensordict import NonTensorData, TensorDict
from torchrl.checkpoint import Checkpoint

import lw_torchrl as lw


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return train_good(tmp_path_factory.mktemp("good"))


def test_a_file_of_version_1_is_named_and_not_unpickled(tmp_path):
    """TorchRL's Checkpoint, with a planted entry of the kind that ran code when it was loaded."""
    path, trace = tmp_path / "old.zip", tmp_path / "executed"
    actor = lw.PlanConditionedActor(PLANS, **SMALL)
    described = {"actor": {"kind": "PlanConditionedActor", "options": actor.config, "plans": {}}}
    Checkpoint(format="archive", description=described, actor=actor).save(path)
    planted = tmp_path / "planted"
    TensorDict({"evil": NonTensorData(Evil(trace))}).memmap(planted)
    trace.unlink(missing_ok=True)
    with zipfile.ZipFile(path, "a") as archive:
        for file in planted.rglob("*"):
            if file.is_file():
                archive.write(file, f"components/state/evil/{file.relative_to(planted)}")
    assert any(name.endswith(".pickle") for name in zipfile.ZipFile(path).namelist())
    with pytest.raises(ValueError, match=r"is of version 1, whose files can run code.*reads version 2"):
        lw.load_actor(path)
    with pytest.raises(ValueError, match="is of version 1"):
        make_trainer(path)
    assert not trace.exists()


@pytest.mark.parametrize(
    "name", ["state/evil/other.pickle", "other.pickle", "../policy.py", "/etc/x", "data.pkl", "weights.safetensors/"]
)
def test_entries_that_no_file_of_ours_has_are_refused(good, tmp_path, name):
    trace = tmp_path / "executed"
    description, groups = parts(good)
    rebuild(tmp_path / "c.zip", description, {**groups, name: pickle.dumps(Evil(trace))})
    refuses(tmp_path / "c.zip")
    assert not trace.exists()
    assert {file.name for file in tmp_path.iterdir()} == {"c.zip"}


def test_compressed_entries_are_refused_before_they_are_unpacked(good, tmp_path):
    """2.8 MB that unpack to 3 GB."""
    description, _ = parts(good)
    path = tmp_path / "c.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("description.json", json.dumps(description))
        with archive.open("weights.safetensors", "w", force_zip64=True) as entry:
            for _ in range(3_000):
                entry.write(bytes(2**20))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    refuses(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 500_000  # kB


def test_entries_that_lie_about_their_size_are_refused(good, tmp_path):
    content = bytearray(good.read_bytes())
    directory = content.rindex(b"PK\x01\x02")
    for size in (0, 1, 2**31):
        struct.pack_into("<II", content, directory + 20, size, size)
        (tmp_path / "c.zip").write_bytes(bytes(content))
        refuses(tmp_path / "c.zip")


def test_an_entry_twice_is_refused(good, tmp_path):
    path = tmp_path / "c.zip"
    path.write_bytes(good.read_bytes())
    with pytest.warns(UserWarning, match="Duplicate name"), zipfile.ZipFile(path, "a") as archive:
        archive.writestr("description.json", "{}")
    refuses(path)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.6, 0.9, 0.99])
def test_a_cut_file_is_refused(good, tmp_path, share):
    content = good.read_bytes()
    (tmp_path / "c.zip").write_bytes(content[: int(share * len(content))])
    refuses(tmp_path / "c.zip")


def test_no_flipped_bit_loads_as_other_weights(good, tmp_path):
    content, expected = good.read_bytes(), lw.load_actor(good).state_dict()
    generator, refused = torch.Generator().manual_seed(0), 0
    for place in torch.randint(8 * len(content), (60,), generator=generator).tolist():
        flipped = bytearray(content)
        flipped[place // 8] ^= 1 << place % 8
        (tmp_path / "c.zip").write_bytes(bytes(flipped))
        try:
            found = lw.load_actor(tmp_path / "c.zip").state_dict()
        except ValueError:
            refused += 1
            continue
        assert all(torch.equal(found[name], expected[name]) for name in expected)
    assert refused >= 50


def test_a_torch_file_is_refused_and_not_unpickled(tmp_path):
    trace = tmp_path / "executed"
    buffer = io.BytesIO()
    torch.save({"weights": Evil(trace)}, buffer)
    (tmp_path / "c.zip").write_bytes(buffer.getvalue())
    refuses(tmp_path / "c.zip")
    assert not trace.exists()
