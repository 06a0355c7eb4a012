"""Policy files that are other archives, damaged or planted with pickles: none runs code or is unpacked."""

from __future__ import annotations

import io
import json
import os
import pickle
import resource
import struct
import zipfile
import zlib
from hashlib import sha256

import pytest
import torch
from hostile_files import PLANS, SMALL, Evil, make_trainer, parts, rebuild, refuses, train_good
from tensordict import NonTensorData, TensorDict
from torchrl.checkpoint import Checkpoint

import lw_torchrl as lw
from lw_torchrl import _tensor_archive
from lw_torchrl.training.envelope import POLICY


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
    with pytest.raises(ValueError, match=r"is of version 1, whose files can run code.*reads version 3"):
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


@pytest.mark.slow
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


def overlapping(groups, size):
    """Bytes of an archive whose groups each reach to the end of the last one's data, of so many bytes."""

    def local(name, content):
        head = struct.pack(
            "<4s5HLLLHH", b"PK\3\4", 20, 0, 0, 0, 33, zlib.crc32(content), *[len(content)] * 2, len(name), 0
        )
        return head + name

    ends, content = {}, bytes(size)
    for name in reversed(groups):
        ends[name] = content
        content = local(name, content) + content
    signed = {name.decode(): sha256(end).hexdigest() for name, end in ends.items()}
    text = json.dumps(
        {"format": "lw_torchrl.policy", "version": POLICY.version, "actor": {}, "sha256": signed}
    ).encode()
    first = local(b"description.json", text) + text
    directory, offset = b"", 0
    for name, entry in {b"description.json": text, **{name: ends[name] for name in groups}}.items():
        sizes = zlib.crc32(entry), len(entry), len(entry), len(name)
        directory += (
            struct.pack("<4s6HLLLHHHHHLL", b"PK\1\2", 20, 20, 0, 0, 0, 33, *sizes, 0, 0, 0, 0, 0, offset) + name
        )
        offset = len(first) if name == b"description.json" else offset + 30 + len(name)
    body = first + content
    number = len(groups) + 1
    return body + directory + struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, number, number, len(directory), len(body), 0)


def test_entries_that_lie_over_one_another_are_refused_unread(tmp_path):
    """Each is as long as the file, so all together take its size times their number."""
    path = tmp_path / "c.zip"
    path.write_bytes(overlapping([b"weights.safetensors", b"texts.safetensors", b"training.safetensors"], 100_000))
    with pytest.raises(ValueError, match=r"its entries say that they have 30\d{4} bytes, it has 10\d{4}"):
        lw.load_actor(path)
    path.write_bytes(overlapping([b"weights_%c.safetensors" % letter for letter in b"abcdefgh"], 10))
    with pytest.raises(ValueError, match="at most 8 entries once, it has 9"):
        lw.load_actor(path)


@pytest.mark.parametrize("offset", [2**40, 2**63 - 1, 2**63, 2**64 - 1])
def test_entries_that_begin_beyond_the_file_are_refused(good, tmp_path, offset):
    description, groups = parts(good)
    rebuild(tmp_path / "c.zip", description, groups)
    content = (tmp_path / "c.zip").read_bytes()
    first, last, end = content.index(b"PK\1\2"), content.rindex(b"PK\1\2"), content.rindex(b"PK\5\6")
    entry = bytearray(content[last:end])
    more = struct.pack("<HHQ", 1, 8, offset)  # the offset stands in a zip64 field
    struct.pack_into("<4HLL", entry, 30, len(more), 0, 0, 0, 0, 2**32 - 1)
    directory = content[first:last] + bytes(entry) + more
    ending = bytearray(content[end:])
    struct.pack_into("<LL", ending, 12, len(directory), first)
    (tmp_path / "c.zip").write_bytes(content[:first] + directory + bytes(ending))
    refuses(tmp_path / "c.zip")


@pytest.mark.usefixtures("in_time")
def test_what_is_no_file_is_refused_unread(tmp_path):
    os.mkfifo(tmp_path / "c.zip")
    (tmp_path / "d.zip").symlink_to("/dev/zero")
    (tmp_path / "e.zip").mkdir()
    for name in ("c.zip", "d.zip", "e.zip"):
        refuses(tmp_path / name)


def test_a_huge_file_is_refused_unread(tmp_path):
    with (tmp_path / "c.zip").open("wb") as file:
        file.truncate(200 * 2**30)  # takes no room
    with pytest.raises(ValueError, match=r"checkpoint: .*c.zip.* larger than \d+ bytes"):
        lw.load_actor(tmp_path / "c.zip")


def test_too_little_memory_for_a_file_is_said_of_it(good, monkeypatch):
    def full(*_):
        raise MemoryError

    monkeypatch.setattr(_tensor_archive, "read_bytes", full)
    refuses(good)


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


def test_a_file_of_version_2_is_refused_by_name(tmp_path):
    """Its weights have other names."""
    path = tmp_path / "c.zip"
    text = json.dumps({"format": "lw_torchrl.policy", "version": 2, "actor": {}, "sha256": {}}).encode()
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("description.json", text)
    with pytest.raises(ValueError, match=r"version 2; this package reads .* version 3\. Train it again"):
        lw.load_actor(path)
