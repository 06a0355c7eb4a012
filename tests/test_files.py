"""Files: replaced whole or not at all, and leftovers found again."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from lw_torchrl import _files
from lw_torchrl._files import held, read_json, replacing, sweep, write_json, write_text


class OwnError(ValueError):
    """A room's error for a place where another is at work."""


LEFT = "0123456789abcdef"  # what the name of a temporary file has in its middle


@pytest.fixture
def locked():
    """A function that lets another process write a file, as :func:`replacing` does, until the test ends."""
    processes = []

    def lock(path):
        script = "import fcntl, sys; file = open(sys.argv[1], 'w'); fcntl.flock(file, fcntl.LOCK_EX); print(); input()"
        command = [sys.executable, "-c", script, str(path)]
        processes.append(subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE))
        processes[-1].stdout.readline()

    yield lock
    for process in processes:
        process.communicate()


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
    temporary = done[0][1]
    assert re.fullmatch(re.escape(str(tmp_path)) + r"/\.a\.[0-9a-f]{16}\.tmp\.json", temporary)
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
counting(_files.fcntl, "flock")
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


def test_leftovers_go_and_what_is_being_written_stays(tmp_path, locked):
    target = tmp_path / "results.json"
    gone = [f".results.{LEFT}.tmp.json", f".results.{LEFT[::-1]}.tmp.json"]
    being_written = f".results.{'f' * 16}.tmp.json"
    stay = [
        f".other.{LEFT}.tmp.json",
        f".results.{LEFT}.tmp.txt",
        f".results.more.{LEFT}.tmp.json",
        f"results.{LEFT}.tmp.json",
        ".results.x.tmp.json",
        f".results.{LEFT}0.tmp.json",
        "results.json",
    ]
    for name in gone + stay:
        (tmp_path / name).write_text(name)
    locked(tmp_path / being_written)
    assert {path.name for path in sweep(target)} == set(gone)
    assert names(tmp_path) == sorted([*stay, being_written])
    assert sweep(target) == []


def test_links_and_folders_of_such_names_stay(tmp_path):
    (tmp_path / "precious").write_text("years of work")
    (tmp_path / f".a.{LEFT}.tmp.json").symlink_to("precious")
    (tmp_path / f".a.{LEFT[::-1]}.tmp.json").mkdir()
    before = names(tmp_path)
    assert sweep(tmp_path / "a.json") == []
    assert names(tmp_path) == before


def test_the_next_write_sweeps_and_leaves_another_writer_alone(tmp_path, locked):
    (tmp_path / f".a.{LEFT}.tmp.json").write_text("half")
    locked(tmp_path / f".a.{LEFT[::-1]}.tmp.json")
    write_json(tmp_path / "a.json", {})
    assert names(tmp_path) == [f".a.{LEFT[::-1]}.tmp.json", "a.json"]


def test_two_writers_of_one_process_do_not_meet(tmp_path):
    """The second began while the first was writing: each has a file of its own, and the last to end stands."""
    target = tmp_path / "a.txt"
    with replacing(target) as first:
        first.write_text("first, ")
        with replacing(target) as second:
            second.write_text("second")
        assert target.read_text() == "second"
        with first.open("a") as file:
            file.write("to its end")
    assert target.read_text() == "first, to its end"
    assert names(tmp_path) == ["a.txt"]


def test_threads_that_write_one_file_leave_a_whole_one(tmp_path):
    target = tmp_path / "a.txt"
    texts = [letter * 100_000 for letter in "abcd"]
    with ThreadPoolExecutor(4) as pool:
        for future in [pool.submit(write_text, target, texts[n % 4]) for n in range(80)]:
            future.result()
            assert target.read_text() in texts
    assert names(tmp_path) == ["a.txt"]


def test_a_file_swept_before_its_writer_locked_it_is_made_anew(tmp_path, monkeypatch):
    target, real, swept = tmp_path / "a.txt", _files.fcntl.flock, []

    def flock(handle, operation):
        if not swept:
            swept.append(True)
            (path,) = tmp_path.glob(".a.*")
            path.unlink()
        real(handle, operation)

    monkeypatch.setattr(_files.fcntl, "flock", flock)
    write_text(target, "whole")
    assert swept
    assert target.read_text() == "whole"


def test_it_has_the_rights_that_any_new_file_has(tmp_path):
    (tmp_path / "other").touch()
    write_text(tmp_path / "a.txt", "")
    assert (tmp_path / "a.txt").stat().st_mode == (tmp_path / "other").stat().st_mode


def test_a_name_with_signs_of_patterns_is_a_name(tmp_path):
    (tmp_path / f".a[b]+.{LEFT}.tmp.json").write_text("half")
    (tmp_path / f".ab.{LEFT}.tmp.json").write_text("another's")
    write_json(tmp_path / "a[b]+.json", {})
    assert names(tmp_path) == [f".ab.{LEFT}.tmp.json", "a[b]+.json"]


def test_sweeping_where_there_is_no_folder_does_nothing(tmp_path):
    assert sweep(tmp_path / "nowhere" / "a.json") == []
    assert not (tmp_path / "nowhere").exists()


NESTED = """
import importlib.util, os, signal, sys
spec = importlib.util.spec_from_file_location("_files", sys.argv[2])
_files = importlib.util.module_from_spec(spec)
spec.loader.exec_module(_files)
with _files.replacing(sys.argv[1]) as outer, _files.replacing(outer) as inner, _files.replacing(inner):
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_what_was_being_replaced_itself_goes_at_the_next_write(tmp_path, locked):
    """As of a killed evaluation, whose recording is made beside its place and made compact there."""
    target = tmp_path / "rollout.rrd"
    subprocess.run([sys.executable, "-c", NESTED, str(target), _files.__file__])
    assert len(names(tmp_path)) == 3
    being_written = tmp_path / f"..rollout.{LEFT}.tmp.{LEFT}.tmp.rrd"
    locked(being_written)
    write_text(target, "new")
    assert names(tmp_path) == [being_written.name, "rollout.rrd"]


# ---- holding a place


@pytest.mark.parametrize("folder", [False, True])
def test_one_process_at_a_time_holds_a_place(tmp_path, holding, folder):
    place = tmp_path / "runs" / "mine.zip"
    release = holding(place, folder=folder)
    other = "folder" if folder else "file"
    said = f"out: another training is at work in '{place}'; let it finish, or choose another {other}"
    with pytest.raises(OwnError) as caught, held(place, "out", "training", folder=folder, error=OwnError):
        pytest.fail("it is held")
    assert str(caught.value) == said
    release()
    again = held(place, "out", folder=folder)
    with held(place, "out", folder=folder), pytest.raises(ValueError, match="another process is at work"), again:
        pytest.fail("a thread is another one too")
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_what_a_killed_process_held_is_free(tmp_path, holding):
    holding(tmp_path / "a.zip").__self__.kill()
    with held(tmp_path / "a.zip", "out"):
        assert names(tmp_path) == [".a.zip.lock"]
    assert names(tmp_path) == []


def test_of_many_that_wait_one_at_a_time_gets_in(tmp_path):
    inside, most = [], []

    def work(number):
        with held(tmp_path / "a", "out", wait=True):
            inside.append(number)
            most.append(len(inside))
            time.sleep(0.002)
            inside.remove(number)

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(work, range(40)))
    assert most == [1] * 40
    assert names(tmp_path) == []


# ---- folders


def test_a_folder_appears_whole_or_not_at_all(tmp_path):
    out = tmp_path / "out"

    def fail():
        with _files.replacing_folder(out) as folder:
            (folder / "half").write_text("half")
            raise RuntimeError("on the way")

    with pytest.raises(RuntimeError, match="on the way"):
        fail()
    assert [*tmp_path.iterdir()] == []
    left = tmp_path / ".out.0123456789abcdef.tmp"  # of a process that was killed
    (left / "inside").mkdir(parents=True)
    with _files.replacing_folder(out) as folder, _files.replacing_folder(tmp_path / "other") as other:
        assert not left.exists()
        (folder / "inside").mkdir()
        (folder / "inside" / "file").write_text("whole")
        with _files.replacing_folder(out):  # of another thread, which leaves the first one alone
            assert (folder / "inside" / "file").exists()
        out.rmdir()
        (other / "file").write_text("whole")
    assert (out / "inside" / "file").read_text() == (tmp_path / "other" / "file").read_text() == "whole"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["other", "out"]
