"""Policy files whose tensors or training states are a stranger's: refused, or whole."""

from __future__ import annotations

import json
import pickle
import struct

import pytest
import torch
from hostile_files import make_trainer, parts, rebuild, refuses, said, train_good
from safetensors.torch import load, save

import lw_torchrl as lw


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return train_good(tmp_path_factory.mktemp("good"))


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


@pytest.mark.parametrize("option", ["depth", "encoder_depth"])
def test_more_layers_than_there_are_weights_are_refused_before_they_are_made(good, tmp_path, option):
    """Their numbers are few enough, but each layer is a module of several kB, and even a list of them takes memory."""
    description, groups = parts(good)
    changed("weights", lambda t: t.update({"more": torch.zeros(30_000)}))(description, groups)
    description["actor"]["options"].update({"width": 1, option: 10_000})
    rebuild(tmp_path / "c.zip", description, groups)
    with pytest.raises(ValueError, match=r"checkpoint: .*describes a network of 1e\+04 layers, but holds only"):
        lw.load_actor(tmp_path / "c.zip")


@pytest.mark.parametrize("shape", [(0, 2**21), (0, 2**40), (1, 2**21)])
def test_texts_of_more_numbers_than_are_stored_are_refused_before_they_are_made(good, tmp_path, shape):
    """Vectors of any length take no room in a file that holds none of them."""
    description, groups = parts(good)

    def widened(tensors):
        for name in tensors:
            tensors[name] = torch.zeros(shape)

    changed("texts", widened)(description, groups)
    rebuild(tmp_path / "c.zip", description, groups)
    with pytest.raises(ValueError, match=r"checkpoint: .*its texts have more numbers than the \d+ that it holds"):
        lw.load_actor(tmp_path / "c.zip")


@pytest.mark.parametrize(
    ("ending", "value", "message"),
    [
        ("weight", float("nan"), "must be finite"),
        ("bias", float("-inf"), "must be finite"),
        ("features.mean", float("inf"), "must be finite"),
        ("features.std", float("nan"), "must be finite"),
        ("features.std", 0.0, "must be above 0"),
        ("features.std", -1.0, "must be above 0"),
    ],
)
def test_weights_that_are_no_numbers_are_refused(good, tmp_path, ending, value, message):
    description, groups = parts(good)

    def spoil(tensors):
        tensors[next(name for name in tensors if name.endswith(ending))].view(-1)[-1] = value

    changed("weights", spoil)(description, groups)
    rebuild(tmp_path / "c.zip", description, groups)
    refuses(tmp_path / "c.zip")
    with pytest.raises(ValueError, match=rf"weights: .*{ending} {message}"):
        lw.load_actor(tmp_path / "c.zip")


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


def entries(tree, key):
    """The pairs of that key in the JSON of a state."""
    inside = tree.values() if isinstance(tree, dict) else tree if isinstance(tree, list) else ()
    for one in inside:
        if isinstance(one, list) and len(one) == 2 and one[0] == key:
            yield one
        yield from entries(one, key)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("T_max", 0), ("base_lrs", {"list": [1e300]}), ("last_epoch", 10**6), ("_step_count", -5),
        ("_last_lr", {"list": [1.0]}), ("lr", -1.0), ("lr", 1e308), ("eps", -1.0), ("betas", {"tuple": [1.0, 1.0]}),
        ("maximize", True), ("amsgrad", True), ("capturable", True), ("differentiable", True), ("weight_decay", 1e9),
        ("step", 10**12), ("step", -1), ("step", 4),
    ],
)  # fmt: skip
def test_values_that_no_such_training_has_are_refused(good, tmp_path, key, value):
    """Each is of the right type; some trained upwards, some divided by zero, some never came to an end."""
    description, groups = parts(good)
    found = [pair for pair in entries(description["state"], key) if "tensor" not in str(pair[1])]
    assert found
    for pair in found:
        pair[1] = value
    rebuild(tmp_path / "c.zip", description, groups)
    with pytest.raises(ValueError, match=r"checkpoint: .* does not fit"):
        make_trainer(tmp_path / "c.zip")


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("step", lambda value: -value), ("step", lambda value: value + 1), ("step", lambda value: value * float("nan")),
        ("exp_avg", lambda value: value + float("inf")), ("exp_avg_sq", lambda value: -1 - value),
    ],
)  # fmt: skip
def test_an_optimizers_state_that_no_steps_give_is_refused(good, tmp_path, name, change):
    description, groups = parts(good)
    place = next(pair[1]["tensor"] for pair in entries(description["state"], name) if isinstance(pair[1], dict))

    def spoil(tensors):
        tensors[place] = change(tensors[place])

    changed("training", spoil)(description, groups)
    rebuild(tmp_path / "c.zip", description, groups)
    with pytest.raises(ValueError, match=rf"does not fit.*'{name}'\] holds what 5 steps cannot give"):
        make_trainer(tmp_path / "c.zip")
