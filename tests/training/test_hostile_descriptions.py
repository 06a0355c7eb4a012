"""Policy files whose descriptions are a stranger's: none exhausts memory, or raises what is not documented."""

from __future__ import annotations

import subprocess
import sys

import pytest
from hostile_files import CONFIG, make_trainer, parts, rebuild, refuses, said, train_good
from hypothesis import given, settings
from hypothesis import strategies as st

import lw_torchrl as lw
from lw_torchrl.training.files import read_description

MOST_MEMORY = 2 * 2**30


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return train_good(tmp_path_factory.mktemp("good"))


BIG = 10**9
VALUES = [None, True, -1, 0, BIG, 10**30, 1e308, 0.5, "", "x" * 100_000, [], [BIG] * 3, {}, {"a": {"b": [1]}}]
OPTIONS = [
    ("width", 60_000), ("width", [60_000, 60_000]), ("width", BIG), ("width", -3), ("width", [16] * 100_000),
    ("depth", BIG), ("depth", 10**15), ("depth", 60_000), ("depth", 1.5), ("depth", "2"),
    ("latent_size", BIG), ("latent_size", 100_000), ("encoder_width", 10**7), ("encoder_depth", BIG),
    ("encoder_depth", 5_000), ("features", "latent"), ("feature_noise", -1), ("feature_noise", "loud"),
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


@pytest.mark.filterwarnings("ignore:checkpoint. .* was written under other versions")
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


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("width", 60_000),
        *(pytest.param(*one, marks=pytest.mark.slow) for one in [("depth", 10**9), ("latent_size", 10**8)]),
    ],
)
def test_sizes_are_checked_before_anything_is_built(good, tmp_path, name, value):
    description, groups = parts(good)
    description["actor"]["options"][name] = value
    rebuild(tmp_path / "c.zip", description, groups)
    command = [sys.executable, "-c", LIMITED.format(most=MOST_MEMORY), str(tmp_path / "c.zip")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "cannot be made (it " in done.stdout
    assert "numbers" in done.stdout


def test_a_good_file_says_what_it_is(good):
    found = read_description(good)
    assert (found["format"], found["version"]) == ("lw_torchrl.policy", 3)
    assert make_trainer(good).steps == CONFIG.steps
