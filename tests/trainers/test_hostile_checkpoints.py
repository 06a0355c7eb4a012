"""Policy files from strangers: none runs code, exhausts memory, or raises what is not documented."""

from __future__ import annotations

import io
import json
import pickle
import resource
import struct
import subprocess
import sys
import zipfile
from hashlib import sha256

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import load, save
from tensordict import NonTensorData, TensorDict
from torchrl.checkpoint import Checkpoint
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

import lw_torchrl as lw
from lw_torchrl.trainers.checkpoint import read_description

PLANS = lw.load_plans("MT10")
SMALL = dict(latent_size=4, width=16, depth=1, encoder_width=8)
CONFIG = lw.BehavioralCloningConfig(steps=5, batch_size=8)
MOST_MEMORY = 2 * 2**30


class Evil:
    """Unpickled, it leaves a trace."""

    def __init__(self, trace):
        self.trace = str(trace)

    def __reduce__(self):
        return (open, (self.trace, "w"))


def make_trainer(path, actor=None):
    rows = 40
    generator = torch.Generator().manual_seed(0)
    data = TensorDict(
        {
            "observation": torch.rand(rows, 39, generator=generator),
            "task_id": torch.tensor([lw.task_id(task) for task in ("push", "reach")]).repeat(rows // 2),
            "qaf": torch.rand(rows, PLANS.num_steps, generator=generator) > 0.5,
            "action": torch.rand(rows, 4, generator=generator) - 0.5,
        },
        [rows],
    )
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(rows), sampler=lw.TaskBalancedSampler())
    replay.extend(data)
    actor = lw.PlanConditionedActor(PLANS, **SMALL) if actor is None else actor
    return lw.BehavioralCloningTrainer(actor, replay, CONFIG, checkpoint=path, progress=False)


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    path = tmp_path_factory.mktemp("good") / "policy.zip"
    torch.manual_seed(0)
    make_trainer(path).train()
    return path


def parts(path):
    """The description and the groups of tensors of a file."""
    with zipfile.ZipFile(path) as archive:
        found = {name: archive.read(name) for name in archive.namelist()}
    return json.loads(found.pop("description.json")), found


def rebuild(path, description, groups, compression=zipfile.ZIP_STORED, text=None, signed=True):
    """Write a file as an attacker would, with sums that agree."""
    if signed and isinstance(description, dict):
        description = {**description, "sha256": {name: sha256(data).hexdigest() for name, data in groups.items()}}
    with zipfile.ZipFile(path, "w", compression) as archive:
        archive.writestr("description.json", json.dumps(description) if text is None else text)
        for name, data in groups.items():
            archive.writestr(name, data)


def refuses(path, *, training=True):
    """Loading says what is wrong, with the file's name, by every way in."""
    with pytest.raises(ValueError, match="checkpoint: ") as caught:
        lw.load_actor(path)
    assert str(path) in str(caught.value)
    if training:
        with pytest.raises(ValueError, match="checkpoint: "):
            make_trainer(path)


def said(load_one, path):
    """The documented error of loading a file; None where it loads."""
    try:
        load_one(path)
    except ValueError as error:
        return str(error)
    return None


# ---------------------------------------------------------------- descriptions

BIG = 10**9
VALUES = [None, True, -1, 0, BIG, 10**30, 1e308, 0.5, "", "x" * 100_000, [], [BIG] * 3, {}, {"a": {"b": [1]}}]
OPTIONS = [
    ("width", 60_000), ("width", [60_000, 60_000]), ("width", BIG), ("width", -3), ("width", [16] * 100_000),
    ("depth", BIG), ("depth", 10**15), ("depth", 60_000), ("depth", 1.5), ("depth", "2"),
    ("latent_size", BIG), ("latent_size", 100_000), ("encoder_width", 10**7), ("encoder_depth", BIG),
    ("encoder_depth", 5_000), ("features", "latent"), ("mix", 3), ("feature_noise", -1), ("feature_noise", None),
    ("swap_unmentioned", 2), ("focus", "yes"), ("focus", True), ("in_keys", ["a"]), ("in_keys", [1, 2, 3]),
    ("in_keys", [[], [], []]), ("out_keys", ["action"] * 3), ("out_keys", "abc"), ("nonsense", 1),
    ("plans", {}), ("text_encoder", "os.system"), ("evaluator", "x"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "value"), OPTIONS, ids=[f"{n}={str(v)[:20]}" for n, v in OPTIONS])
def test_options_of_other_sizes_and_kinds_are_refused(good, tmp_path, name, value):
    description, groups = parts(good)
    description["actor"]["options"][name] = value
    rebuild(tmp_path / "c.zip", description, groups)
    refuses(tmp_path / "c.zip")


@pytest.mark.parametrize("value", VALUES, ids=lambda value: str(value)[:20])
@pytest.mark.parametrize("where", ["actor", "kind", "options", "plans", "plan", "format", "version", "sha256"])
def test_values_of_other_types_are_refused(good, tmp_path, where, value):
    description, groups = parts(good)
    if where in ("kind", "options", "plans"):
        description["actor"][where] = value
    elif where == "plan":
        description["actor"]["plans"]["reach"] = value
    else:
        description[where] = value
    rebuild(tmp_path / "c.zip", description, groups, signed=where != "sha256")
    refuses(tmp_path / "c.zip")


DEEP = 100_000
TEXTS = {
    "nested lists": "[" * DEEP + "]" * DEEP,
    "nested objects": '{"a":' * DEEP + "1" + "}" * DEEP,
    "a number of 5000 digits": '{"format": ' + "9" * 5000 + "}",
    "NaN": '{"format": NaN}',
    "no object": "[1, 2]",
    "no JSON": "import os",
    "no UTF-8": b"\xff\xfe{}",
    "empty": "",
}


@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS)
def test_descriptions_that_are_no_json_of_ours_are_refused(good, tmp_path, text):
    _, groups = parts(good)
    rebuild(tmp_path / "c.zip", None, groups, text=text)
    refuses(tmp_path / "c.zip")


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_any_change_of_the_description_is_harmless(good, tmp_path_factory, data):
    """A value anywhere in it becomes another: it loads as a policy, or is refused by a ValueError."""
    path = tmp_path_factory.mktemp("any") / "c.zip"
    description, groups = parts(good)
    here, key = {"description": description}, "description"
    for _ in range(data.draw(st.integers(1, 6))):
        inside = here[key]
        keys = (
            list(inside) if isinstance(inside, dict) else list(range(len(inside))) if isinstance(inside, list) else []
        )
        if not keys:
            break
        here, key = inside, data.draw(st.sampled_from(keys))
    here[key] = data.draw(st.sampled_from(VALUES))
    rebuild(path, description, groups)
    for load_one in (lw.load_actor, make_trainer):
        assert "checkpoint: " in (said(load_one, path) or "checkpoint: ")


# ---------------------------------------------------------------- tensors


def changed(group, change):
    def apply(description, groups):
        tensors = load(groups[f"{group}.safetensors"])
        change(tensors)
        groups[f"{group}.safetensors"] = save(tensors)

    return apply


def replaced(group, change):
    def apply(description, groups):
        name = f"{group}.safetensors"
        groups[name] = change(groups[name])

    return apply


def first(tensors):
    return next(name for name, tensor in sorted(tensors.items()) if tensor.numel() > 1)


def with_header(header, rest=b""):
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + rest


CHANGES = {
    "shorter": lambda t: t.update({first(t): t[first(t)][:-1].clone()}),
    "empty": lambda t: t.update({first(t): t[first(t)][:0].clone()}),
    "scalar": lambda t: t.update({first(t): torch.tensor(0.0)}),
    "halves": lambda t: t.update({first(t): t[first(t)].half()}),
    "doubles": lambda t: t.update({first(t): t[first(t)].double()}),
    "integers": lambda t: t.update({first(t): t[first(t)].to(torch.int32)}),
    "one missing": lambda t: t.pop(first(t)),
    "one too many": lambda t: t.update({"more": torch.zeros(3)}),
    "another name": lambda t: t.update({"other": t.pop(first(t))}),
    "none at all": lambda t: t.clear(),
}
RAW = {
    "nothing": lambda data: b"",
    "a pickle": lambda data: pickle.dumps([1]),
    "cut": lambda data: data[: len(data) // 2],
    "zeros": lambda data: bytes(len(data)),
    "a header of 2**60 bytes": lambda data: struct.pack("<Q", 2**60) + data[8:],
    "a tensor of 2**40 numbers": lambda data: with_header(
        {"a": {"dtype": "F32", "shape": [2**40], "data_offsets": [0, 2**42]}}
    ),
    "offsets that overlap": lambda data: with_header(
        {name: {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]} for name in "ab"}, bytes(4)
    ),
    "a negative shape": lambda data: with_header(
        {"a": {"dtype": "F32", "shape": [-1], "data_offsets": [0, 4]}}, bytes(4)
    ),
    "an unknown dtype": lambda data: with_header(
        {"a": {"dtype": "PY", "shape": [1], "data_offsets": [0, 4]}}, bytes(4)
    ),
    "a header that is no JSON": lambda data: with_header(b"import os"),
    "a nested header": lambda data: with_header(b"[" * 50_000),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
@pytest.mark.parametrize("group", ["weights", "texts", "training"])
def test_tensors_of_other_shapes_names_and_types_are_refused(good, tmp_path, group, change):
    """None is loaded as zeros."""
    description, groups = parts(good)
    changed(group, change)(description, groups)
    rebuild(tmp_path / "c.zip", description, groups)
    if group == "training":  # the policy itself is whole
        lw.load_actor(tmp_path / "c.zip")
        if change is CHANGES["one too many"]:
            return
        with pytest.raises(ValueError, match=r"checkpoint: .* does not fit"):
            make_trainer(tmp_path / "c.zip")
    elif (group, change) == ("texts", CHANGES["one too many"]):
        lw.load_actor(tmp_path / "c.zip")
    else:
        refuses(tmp_path / "c.zip")


@pytest.mark.parametrize("change", RAW.values(), ids=RAW)
@pytest.mark.parametrize("group", ["weights", "texts"])
def test_tensors_that_are_no_safetensors_are_refused(good, tmp_path, group, change):
    description, groups = parts(good)
    replaced(group, change)(description, groups)
    rebuild(tmp_path / "c.zip", description, groups)
    refuses(tmp_path / "c.zip")


STATES = {
    "no state": None,
    "a list": [1, 2],
    "a missing tensor": {"tensor": "9999"},
    "another kind": {"object": "os.system"},
    "two kinds": {"dict": [], "list": []},
    "no pairs": {"dict": [1, 2]},
    "unhashable keys": {"dict": [[{"list": []}, 1]]},
    "nested": {"dict": []},
}
STATES["nested"] = json.loads('{"list":[' * 400 + "1" + "]}" * 400)


@pytest.mark.parametrize("state", STATES.values(), ids=STATES)
def test_training_states_of_other_shapes_are_refused(good, tmp_path, state):
    description, groups = parts(good)
    description["state"] = state
    rebuild(tmp_path / "c.zip", description, groups)
    with pytest.raises(ValueError, match=r"checkpoint: .* does not fit"):
        make_trainer(tmp_path / "c.zip")


def leaves(tree, path=()):
    if isinstance(tree, dict):
        for key, value in tree.items():
            yield from leaves(value, (*path, key))
    elif isinstance(tree, list):
        for number, value in enumerate(tree):
            yield from leaves(value, (*path, number))
    else:
        yield path


@pytest.mark.parametrize("value", [None, -(10**30), "step", 1e308, True])
def test_every_value_of_a_training_state_may_be_another(good, tmp_path, value):
    """It is refused, or it is a state that training goes on from; never another error."""
    description, groups = parts(good)
    places = list(leaves(description["state"]))[::7]
    for place in places:
        again = json.loads(json.dumps(description))
        here = again["state"]
        for key in place[:-1]:
            here = here[key]
        here[place[-1]] = value
        rebuild(tmp_path / "c.zip", again, groups)
        assert "checkpoint: " in (said(make_trainer, tmp_path / "c.zip") or "checkpoint: ")


# ---------------------------------------------------------------- archives


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


LIMITED = """
import resource, sys
import lw_torchrl as lw
lw.load_plans("MT10")
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + {most}, used + {most}))
try:
    lw.load_actor(sys.argv[1])
except ValueError as error:
    print(error)
"""


@pytest.mark.parametrize(("name", "value"), [("width", 60_000), ("depth", 10**9), ("latent_size", 10**8)])
def test_sizes_are_checked_before_anything_is_built(good, tmp_path, name, value):
    description, groups = parts(good)
    description["actor"]["options"][name] = value
    rebuild(tmp_path / "c.zip", description, groups)
    command = [sys.executable, "-c", LIMITED.format(most=MOST_MEMORY), str(tmp_path / "c.zip")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "cannot be made (it " in done.stdout
    assert "numbers" in done.stdout


def test_a_torch_file_is_refused_and_not_unpickled(tmp_path):
    trace = tmp_path / "executed"
    buffer = io.BytesIO()
    torch.save({"weights": Evil(trace)}, buffer)
    (tmp_path / "c.zip").write_bytes(buffer.getvalue())
    refuses(tmp_path / "c.zip")
    assert not trace.exists()


def test_a_good_file_says_what_it_is(good):
    found = read_description(good)
    assert (found["format"], found["version"]) == ("lw_torchrl.policy", 2)
    assert make_trainer(good).state.step == CONFIG.steps
