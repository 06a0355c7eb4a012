"""Files: text, TOML and JSON are read whole or refused in one way."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from lw_torchrl import _files
from lw_torchrl._files import read_json, read_text, read_toml, write_json


class OwnError(ValueError):
    """A room's error for a file that is none of its own."""


# ---- text


@pytest.mark.usefixtures("in_time")
def test_text_is_read_from_files_alone_and_up_to_the_limit(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path, tmp_path / "pipe", Path("/dev/zero")):
        with pytest.raises(OwnError, match=f"{path}: must be a text file in UTF-8: it is no file"):
            read_text(path, OwnError)
    with (tmp_path / "large").open("wb") as file:
        file.truncate(_files.JSON_LIMIT + 1)
    with pytest.raises(OwnError, match=f"large: must be a text file in UTF-8: it is larger than {_files.JSON_LIMIT} b"):
        read_text(tmp_path / "large", OwnError)


def test_text_has_one_kind_of_line_end_and_no_byte_order_mark(tmp_path):
    (tmp_path / "a.txt").write_bytes("\ufeffä\r\nb\rc\n".encode())
    assert read_text(tmp_path / "a.txt", OwnError) == "ä\nb\nc\n"
    with pytest.raises(FileNotFoundError):
        read_text(tmp_path / "nowhere", OwnError)


# ---- TOML


def read_toml_text(tmp_path, text):
    (tmp_path / "tasks.toml").write_text(text)
    return read_toml(tmp_path / "tasks.toml", OwnError)


@pytest.mark.usefixtures("in_time")
@pytest.mark.parametrize(
    ("text", "says"),
    [
        (".".join("a" * 50_000) + " = 1", "a key of line 1 has 50000 nested keys, at most 16 are read"),
        ("x = 1\n" + " . ".join(["'a b'"] * 17) + " = 1", "a key of line 2 has 17 nested keys, at most 16 are read"),
        ('[a]\nb = {"x"' + ".y" * 30_000 + "=1}", "a key of line 2 has 30001 nested keys"),
        ("[" + "a." * 20_000 + "b]", "a key of line 1 has 20001 nested keys"),
        ("a = " + "[" * 50_000, "it is nested too deeply"),
        ("a = " + "{a=" * 50_000, "it is nested too deeply"),
        ("#" * (2**18 + 1), "it is larger than 262144 bytes"),
    ],
    ids=["dotted", "quoted", "inline", "table", "lists", "tables", "large"],
)
def test_toml_is_read_up_to_limits(tmp_path, text, says):
    with pytest.raises(OwnError) as caught:
        read_toml_text(tmp_path, text)
    assert str(caught.value).startswith(f"{tmp_path / 'tasks.toml'}: ")
    assert says in str(caught.value)


def test_toml_below_its_limits_is_read(tmp_path):
    deep = ".".join("a" * 16)
    text = f'{deep} = "{".".join("b" * 40)}"\n# {"..." * 40}\nc = [{"1.5, " * 40}]\n'
    found = read_toml_text(tmp_path, text)
    assert found["c"] == [1.5] * 40
    for _ in range(16):
        found = found["a"]
    assert found == ".".join("b" * 40)


# ---- JSON

BAD = {
    "nothing": (b"", "Expecting value"),
    "half": (b'{"a": ', "Expecting value"),
    "no UTF-8": (b'{"a": "\xff"}', "utf-8"),
    "nested": (b'{"a": ' + b"[" * 100_000 + b"]" * 100_000 + b"}", "nested too deeply"),
    "nested objects": (b'{"a": ' * 100_000 + b"1" + b"}" * 100_000, "nested too deeply"),
    "unclosed": (b"[" * 1_000_000, "nested too deeply"),
    "a number of 5000 digits": (b'{"a": ' + b"7" * 5000 + b"}", "4300 digits"),
    "NaN": (b'{"a": NaN}', "it holds NaN, which is no JSON"),
    "infinity": (b'{"a": -Infinity}', "it holds -Infinity, which is no JSON"),
    "a float beyond": (b'{"a": 1e999}', "1e999, which is too large"),
    "twice": (b'{"a": 1, "b": {"c": 1, "c": 2}}', "it names 'c' more than once"),
    "a list": (b"[1]", "must be an object, got list"),
    "a text": (b'"a"', "must be an object, got str"),
    "none": (b"null", "must be an object, got NoneType"),
    "two": (b"{}{}", "Extra data"),
    "a mark": (b"\xef\xbb\xbf{}", "BOM"),
    "zeros": (b"\x00" * 100, "Expecting value"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_file_is_a_value_error_that_names_it_and_says_why(tmp_path, name):
    path = tmp_path / "a.json"
    path.write_bytes(BAD[name][0])
    with pytest.raises(ValueError, match=BAD[name][1]) as caught:
        read_json(path, "root: the metadata")
    assert str(caught.value).startswith(f"root: the metadata {str(path)!r} cannot be read: ")
    assert type(caught.value) is ValueError
    assert len(str(caught.value)) < 500


def test_a_file_is_read_up_to_the_limit(tmp_path):
    path = tmp_path / "a.json"
    path.write_text('{"a": 1}')
    assert read_json(path, "it", limit=8) == {"a": 1}
    with pytest.raises(ValueError, match="larger than 7 bytes"):
        read_json(path, "it", limit=7)
    with path.open("wb") as file:
        file.truncate(2**40)  # takes no room; reading all of it would
    with pytest.raises(ValueError, match=f"larger than {_files.JSON_LIMIT} bytes"):
        read_json(path, "it")


def test_what_is_missing_or_no_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.json"):
        read_json(tmp_path / "nowhere.json", "it")
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path, tmp_path / "pipe"):
        with pytest.raises(ValueError, match="it is no file"):
            read_json(path, "it")


def test_what_was_written_reads_back(tmp_path):
    value = {"a": [1, 2.5, -0.0, None, True, "ü\u2028"], "b": {"c": 10**400}}
    write_json(tmp_path / "a.json", value)
    assert read_json(tmp_path / "a.json", "it") == value == json.loads((tmp_path / "a.json").read_text("utf-8"))
