"""Files are replaced whole or not at all, read whole or refused, and locked for one writer."""

import json
import os
import re
import signal
import stat
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from lw_torchrl._util import files as _files
from lw_torchrl._util.files import locked, read_json, read_text, replacing, replacing_folder, write_json, write_text
from lw_torchrl._util.tensor_files import read_tensors


class OwnError(ValueError):
    """An error class that a reader passes."""


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_content_is_synced_before_the_rename(tmp_path, monkeypatch):
    calls, real_sync, real_replace = [], os.fsync, os.replace

    def fsync(handle):
        calls.append(("fsync", os.readlink(f"/proc/self/fd/{handle}")))
        real_sync(handle)

    def replace(*args):
        calls.append(("replace", str(args[1])))
        real_replace(*args)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(os, "replace", replace)
    target = tmp_path / "a.json"
    write_text(target, "new")
    temporary = calls[0][1]
    assert re.fullmatch(re.escape(str(tmp_path)) + r"/\.a\.json\.\w+\.tmp/a\.json", temporary)
    assert calls == [("fsync", temporary), ("replace", str(target)), ("fsync", str(tmp_path))]
    calls.clear()
    with replacing(target, sync=False) as path:
        path.write_text("newer")
        assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700, "a private file is private while it is written"
    assert calls == [("replace", str(target))]
    assert target.read_text() == "newer"


def test_error_leaves_only_the_old_file(tmp_path):
    target = tmp_path / "a.json"
    write_json(target, {"x": 1})
    with pytest.raises(ValueError, match="surrogates"):
        write_text(target, "half\ud800")
    with pytest.raises(ValueError, match="JSON"):
        write_json(target, {"x": float("nan")})
    assert read_json(target, "it") == {"x": 1}
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
for name in ("open", "fsync", "close", "replace"):
    counting(os, name)
import pathlib
for name in ("write_text", "unlink", "mkdir"):
    counting(pathlib.Path, name)
_files.write_text(target, "new" * 1000)
"""


def test_killed_write_leaves_the_old_or_the_new_file(tmp_path):
    target, seen = tmp_path / "a.txt", set()
    for stop in range(20):
        target.write_text("old")
        command = [sys.executable, "-c", KILLED, str(stop), str(target), _files.__file__]
        done = subprocess.run(command, capture_output=True, text=True)
        seen.add(target.read_text())
        if done.returncode == 0:
            break
        assert done.returncode == -signal.SIGKILL, done.stderr
    assert stop >= 6
    assert seen == {"old", "new" * 1000}


def test_threads_that_write_one_file_leave_a_whole_one(tmp_path):
    target = tmp_path / "a.txt"
    texts = [letter * 100_000 for letter in "abcd"]
    with ThreadPoolExecutor(4) as pool:
        for future in [pool.submit(write_text, target, texts[n % 4]) for n in range(80)]:
            future.result()
            assert target.read_text() in texts
    assert names(tmp_path) == ["a.txt"]


def test_a_link_and_a_mode_are_kept(tmp_path):
    (tmp_path / "runs").mkdir()
    target, link = tmp_path / "runs" / "v1.json", tmp_path / "best.json"
    target.write_text("old")
    write_text(tmp_path / "new.json", "")
    assert (tmp_path / "new.json").stat().st_mode == target.stat().st_mode, "a new file has the usual permissions"
    target.chmod(0o640)
    link.symlink_to("runs/v1.json")
    write_text(link, "new")
    assert (link.is_symlink(), target.read_text(), stat.S_IMODE(target.stat().st_mode)) == (True, "new", 0o640)
    (tmp_path / "next.json").symlink_to("runs/v2.json")  # the file that it points to does not exist yet
    write_text(tmp_path / "next.json", "second")
    assert (tmp_path / "runs" / "v2.json").read_text() == "second"
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(OSError, match="loop"):
        write_text(tmp_path / "loop", "x")
    assert (tmp_path / "loop").is_symlink()
    assert names(tmp_path / "runs") == ["v1.json", "v2.json"]


@pytest.mark.parametrize("kind", [stat.S_IFIFO, stat.S_IFCHR, stat.S_IFSOCK, stat.S_IFDIR])
def test_devices_fifos_sockets_and_folders_are_not_replaced(tmp_path, kind):
    path = tmp_path / "place.png"
    if kind == stat.S_IFCHR and os.geteuid() != 0:
        pytest.skip("only root can make a device")
    path.mkdir() if kind == stat.S_IFDIR else os.mknod(path, 0o600 | kind, os.makedev(1, 3))  # 1, 3: /dev/null
    with pytest.raises(OSError, match=r"place\.png"):
        write_text(path, "text")
    assert stat.S_IFMT(path.stat().st_mode) == kind
    assert names(tmp_path) == ["place.png"]


def test_the_home_folder_is_expanded(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    write_text("~/runs/a.txt", "a")
    assert (tmp_path / "home" / "runs" / "a.txt").read_text() == "a"
    write_text("~a.txt", "b")
    assert names(tmp_path) == ["home", "~a.txt"]


def test_leftovers_of_killed_processes_are_removed(tmp_path):
    for name in ("a.txt", "b.txt"):
        left = tmp_path / f".{name}.{'0' * 16}.tmp"
        left.mkdir()
        (left / name).touch()
        os.utime(left, (1.0, 1.0))
    write_text(tmp_path / "a.txt", "new")
    assert names(tmp_path) == [f".b.txt.{'0' * 16}.tmp", "a.txt"]


def test_folder_appears_whole_or_not_at_all(tmp_path):
    out = tmp_path / "out"
    with pytest.raises(ValueError, match="surrogates"), replacing_folder(out) as folder:
        (folder / "half").write_text("half\ud800", encoding="utf-8")
    assert names(tmp_path) == []
    with replacing_folder(out) as folder:
        (folder / "inside").mkdir()
        (folder / "inside" / "file").write_text("whole")
        assert not out.exists()
    assert (out / "inside" / "file").read_text() == "whole"
    assert names(tmp_path) == ["out"]


@pytest.mark.parametrize("folder", [False, True])
def test_second_writer_raises_or_waits(tmp_path, holding, folder):
    place = tmp_path / "runs" / "mine.txt"
    release = holding(place, folder=folder)
    other = "folder" if folder else "file"
    message = f"out: another training is writing to '{place}'; wait until it finishes, or use a different {other}"
    with pytest.raises(OwnError) as caught, locked(place, "out", "training", folder=folder, error=OwnError):
        pytest.fail("another process has the lock")
    assert str(caught.value) == message
    release()
    with locked(place, "out", folder=folder):
        pass
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_killed_process_releases_its_lock(tmp_path, holding):
    holding(tmp_path / "a.txt").__self__.kill()
    with locked(tmp_path / "a.txt", "out"):
        assert names(tmp_path) == [".a.txt.lock"]
    assert names(tmp_path) == []


def test_waiting_threads_enter_one_at_a_time(tmp_path):
    inside, most = [], []

    def work(number):
        with locked(tmp_path / "a", "out", wait=True):
            inside.append(number)
            most.append(len(inside))
            time.sleep(0.002)
            inside.remove(number)

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(work, range(40)))
    assert most == [1] * 40
    assert names(tmp_path) == []


def test_text_has_plain_line_ends_and_no_byte_order_mark(tmp_path):
    (tmp_path / "a.txt").write_bytes("\ufeffä\r\nb\rc\n".encode())
    assert read_text(tmp_path / "a.txt", OwnError) == "ä\nb\nc\n"
    with pytest.raises(FileNotFoundError):
        read_text(tmp_path / "nowhere", OwnError)
    with pytest.raises(OwnError, match=r"a\.txt: must have at most 3 bytes, got"):
        read_text(tmp_path / "a.txt", OwnError, limit=3)
    (tmp_path / "a.txt").write_bytes(b"\xff")
    with pytest.raises(OwnError, match=r"a\.txt: must be a UTF-8 text file"):
        read_text(tmp_path / "a.txt", OwnError)


@pytest.mark.parametrize("text", ["a = ", "[a]\n[a]", "a = " + "[" * 50_000])
def test_toml_errors_name_the_file(tmp_path, text):
    (tmp_path / "tasks.toml").write_text(text)
    with pytest.raises(OwnError, match=r"tasks\.toml: "):
        _files.read_toml(tmp_path / "tasks.toml", OwnError)


BAD = {
    "half": (b'{"a": ', "Expecting value"),
    "not UTF-8": (b'{"a": "\xff"}', "utf-8"),
    "nested": (b'{"a": ' + b"[" * 100_000 + b"]" * 100_000 + b"}", "nested too deeply"),
    "NaN": (b'{"a": NaN}', "only finite numbers, got NaN"),
    "a float beyond": (b'{"a": 1e999}', "only finite numbers, got 1e999"),
    "twice": (b'{"a": 1, "b": {"c": 1, "c": 2}}', "the key 'c' more than once"),
    "a list": (b"[1]", "must be an object, got list"),
}


@pytest.mark.parametrize("name", BAD)
def test_wrong_json_raises(tmp_path, name):
    path = tmp_path / "a.json"
    path.write_bytes(BAD[name][0])
    with pytest.raises(ValueError, match=BAD[name][1]) as caught:
        read_json(path, "root: the metadata")
    assert str(caught.value).startswith(f"root: the metadata {str(path)!r} cannot be read: ")
    assert len(str(caught.value)) < 500


def test_written_json_is_read_back(tmp_path):
    value = {"a": [1, 2.5, -0.0, None, True, "ü\u2028"], "b": {"c": 10**400}}
    write_json(tmp_path / "a.json", value)
    assert read_json(tmp_path / "a.json", "it") == value
    with pytest.raises(FileNotFoundError, match=r"nowhere\.json"):
        read_json(tmp_path / "nowhere.json", "it")


@pytest.mark.parametrize("depth", [199, 250, 900])
def test_json_that_is_nested_deeply_is_invalid_also_in_a_policy(tmp_path, depth):
    nested = b'{"a": "[{", "b": ' + b"[" * depth + b"]" * depth + b"}"
    header = json.dumps({"__metadata__": {"lw_torchrl": nested.decode()}}).encode()
    (tmp_path / "a.safetensors").write_bytes(len(header).to_bytes(8, "little") + header)
    with pytest.raises(ValueError, match="not written by lw_torchrl" if depth < 200 else "nested too deeply"):
        read_tensors(tmp_path / "a.safetensors")


def test_a_program_is_limited_in_time_and_memory(monkeypatch):
    done = _files.run_limited([sys.executable, "-c", "import sys; print('read'); sys.exit('odd')"], 10)
    assert (done.returncode, done.stdout, done.stderr) == (1, b"read\n", b"odd\n")
    if sys.platform == "linux":
        assert b"MemoryError" in _files.run_limited([sys.executable, "-c", "bytes(10**9)"], 10).stderr
    monkeypatch.setattr(_files, "_SECONDS", 1)
    with pytest.raises(_files.LimitError, match="limits of 1 s"):
        _files.run_limited([sys.executable, "-c", "while True: pass"], 10)
