"""Files: replaced whole or not at all, leftovers found again, and JSON read whole or refused in one way."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys

import pytest

from lw_torchrl import _files
from lw_torchrl._files import read_json, replacing, sweep, write_json, write_text


@pytest.fixture
def dead():
    """The number of a process that has ended."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


@pytest.fixture
def live():
    """The number of another process that runs."""
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    yield process.pid
    process.kill()
    process.wait()


def names(folder):
    return sorted(path.name for path in folder.iterdir())


# ---- replacing


def test_the_content_is_on_the_disk_before_it_takes_the_name_and_then_the_name(tmp_path, monkeypatch):
    done = []
    real_sync, real_replace = os.fsync, os.replace

    def fsync(handle):
        done.append(("fsync", os.readlink(f"/proc/self/fd/{handle}")))
        real_sync(handle)

    def replace(*args):
        done.append(("replace", str(args[1])))
        real_replace(*args)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(os, "replace", replace)
    target = tmp_path / "a.json"
    write_text(target, "new")
    temporary = str(tmp_path / f".a.{os.getpid()}.tmp.json")
    assert done == [("fsync", temporary), ("replace", str(target)), ("fsync", str(tmp_path))]
    assert target.read_text() == "new"
    done.clear()
    with replacing(target, sync=False) as path:
        path.write_text("newer")
    assert done == [("replace", str(target))]
    assert target.read_text() == "newer"


def test_an_error_leaves_the_old_file_and_nothing_else(tmp_path):
    target = tmp_path / "a.txt"
    write_text(target, "old")

    def fail(path):
        path.write_text("half")
        raise RuntimeError

    with pytest.raises(RuntimeError), replacing(target) as path:
        fail(path)
    assert target.read_text() == "old"
    assert names(tmp_path) == ["a.txt"]


def test_nan_is_refused_and_the_old_file_stays(tmp_path):
    write_json(tmp_path / "a.json", {"x": 1})
    with pytest.raises(ValueError, match="JSON"):
        write_json(tmp_path / "a.json", {"x": float("nan")})
    assert read_json(tmp_path / "a.json", "it") == {"x": 1}
    assert names(tmp_path) == ["a.json"]


KILLED = """
import importlib.util, os, signal, sys

stop, target = int(sys.argv[1]), sys.argv[2]
spec = importlib.util.spec_from_file_location("_files", sys.argv[3])  # the package would take seconds to import
_files = importlib.util.module_from_spec(spec)
spec.loader.exec_module(_files)

def counting(module, name):
    real = getattr(module, name)
    def call(*args, **kwargs):
        global stop
        if stop == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        stop -= 1
        return real(*args, **kwargs)
    setattr(module, name, call)

for name in ("open", "fsync", "close", "replace", "listdir"):
    counting(os, name)
import pathlib
for name in ("write_text", "unlink", "mkdir"):
    counting(pathlib.Path, name)
_files.write_text(target, "new" * 1000)
"""


def test_killed_at_any_moment_the_file_is_the_old_or_the_new_and_the_next_write_clears_up(tmp_path):
    target, seen = tmp_path / "a.txt", set()
    for stop in range(40):
        target.write_text("old")
        command = [sys.executable, "-c", KILLED, str(stop), str(target), _files.__file__]
        done = subprocess.run(command, capture_output=True, text=True)
        seen.add(target.read_text())
        assert seen <= {"old", "new" * 1000}
        if done.returncode == 0:
            break
        assert done.returncode == -signal.SIGKILL, done.stderr
    assert stop >= 6, "it is killed at several moments"
    assert seen == {"old", "new" * 1000}
    assert names(tmp_path) == ["a.txt"]


# ---- sweeping


def test_leftovers_of_dead_processes_and_of_this_one_go_and_those_of_live_ones_stay(tmp_path, dead, live):
    target = tmp_path / "results.json"
    gone = [f".results.{dead}.tmp.json", f".results.{os.getpid()}.tmp.json", ".results.4294967295.tmp.json"]
    stay = [
        f".results.{live}.tmp.json",
        ".results.1.tmp.json",  # a process of another user, as a rule
        f".other.{dead}.tmp.json",
        f".results.{dead}.tmp.txt",
        f".results.more.{dead}.tmp.json",
        f"results.{dead}.tmp.json",
        ".results.x.tmp.json",
        ".results.0.tmp.json",
        "results.json",
    ]
    for name in gone + stay:
        (tmp_path / name).write_text(name)
    assert {path.name for path in sweep(target)} == set(gone)
    assert names(tmp_path) == sorted(stay)
    assert sweep(target) == []


def test_the_next_write_sweeps_and_leaves_a_live_writer_alone(tmp_path, dead, live):
    for process in (dead, live):
        (tmp_path / f".a.{process}.tmp.json").write_text("half")
    write_json(tmp_path / "a.json", {})
    assert names(tmp_path) == [f".a.{live}.tmp.json", "a.json"]


def test_a_name_with_signs_of_patterns_is_a_name(tmp_path, dead):
    (tmp_path / f".a[b]+.{dead}.tmp.json").write_text("half")
    (tmp_path / f".ab.{dead}.tmp.json").write_text("another's")
    write_json(tmp_path / "a[b]+.json", {})
    assert names(tmp_path) == [f".ab.{dead}.tmp.json", "a[b]+.json"]


def test_sweeping_where_there_is_no_folder_does_nothing(tmp_path):
    assert sweep(tmp_path / "nowhere" / "a.json") == []
    assert not (tmp_path / "nowhere").exists()


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
