"""A disk that fills while demonstrations are collected: said, nothing lost, and the next call carries on."""

from __future__ import annotations

import errno
import os
import subprocess
import sys

import pytest

from lw_torchrl.data.missing_episodes import write_failed

COLLECT = """
import os, sys
from lw_torchrl.data import collect_demonstrations
from lw_torchrl.data.memory_map import row_bytes
from lw_torchrl.language.layout import METAWORLD

folder, plain = sys.argv[1:]
options = dict(episodes_per_task=4, max_steps=120, noise_scale=(0.0, 0.3), num_envs=1, progress=False)
rows = 4 * 120 * row_bytes(METAWORLD)

def collect(root):
    return collect_demonstrations("reach", root=root, **options)

def fails(size, message):
    if os.system(f"mount -o remount,size={size} {folder}"):
        raise SystemExit("remounting failed")
    try:
        collect(folder + "/demos")
    except OSError as error:
        assert error.errno == 28, error
        assert message in str(error) and "the same collect_demonstrations carries on" in str(error), error
    else:
        raise SystemExit("there was room")
    return sorted(name for name in os.listdir(folder + "/demos/.partial") if name.endswith(".npz"))

def tree(root):
    found = {}
    for folder, _, names in os.walk(root):
        for name in names:
            path = os.path.join(folder, name)
            found[os.path.relpath(path, root)] = open(path, "rb").read()
    return found

one = rows // 4
some = fails(one * 2 + 40_000, f"bytes to '{folder}/demos/.partial'")
assert some == ["reach.0.npz", "reach.1.npz"], some
every = fails(one * 6, f"writing {rows} bytes to '{folder}/demos'")
assert every == [f"reach.{k}.npz" for k in range(4)], every
fails(one * 6, f"writing {rows} bytes to '{folder}/demos'")
os.system(f"mount -o remount,size={rows * 4} {folder}")
made = collect(folder + "/demos")
assert collect(folder + "/demos") == made
collect(plain)
assert tree(folder + "/demos") == tree(plain)
print("as good as new")
"""


@pytest.fixture
def small_disk(tmp_path):
    """A folder with a file system of its own, whose size can be changed."""
    folder = tmp_path / "disk"
    folder.mkdir()
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=1m", "none", str(folder)], capture_output=True, text=True
    )
    if done.returncode:
        pytest.skip(f"mounting a file system is not allowed here: {done.stderr.strip()}")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="a small tmpfs is Linux's")
def test_a_full_disk_is_said_and_nothing_is_lost(small_disk, tmp_path):
    command = [sys.executable, "-W", "ignore", "-c", COLLECT, str(small_disk), str(tmp_path / "plain")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, env={**os.environ})
    assert (done.returncode, done.stdout) == (0, "as good as new\n"), done.stderr


def test_only_a_full_disk_wants_room(tmp_path):
    assert "once there is room" in str(write_failed(tmp_path, 7, OSError(errno.ENOSPC, "No space left on device")))
    other = str(write_failed(tmp_path, 7, OSError(errno.ENOTDIR, "Not a directory")))
    assert "writing 7 bytes" in other
    assert "Not a directory" in other
    assert "room" not in other
