"""A save killed at any moment: the old file or the new one is there, whole, and the next save leaves nothing lying."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap

import pytest
import torch

import lw_torchrl as lw

KILLER = """
    import os, signal, sys, threading
    import torch
    import lw_torchrl as lw
    from lw_torchrl._files import sweep

    path, moments = sys.argv[1], int(sys.argv[2])
    plans = lw.load_plans("MT10")

    def make(seed):
        torch.manual_seed(seed)
        return lw.PlanConditionedActor(plans, latent_size=4, width=8, depth=1, encoder_width=8)

    first, second = make(0), make(1)
    lw.save_actor(first, path)
    files = ("_files.py", "_tensor_archive.py", "zipfile.py", "pathlib.py", "shutil.py")

    def lines(moment):
        count = 0
        def trace(frame, event, argument):
            nonlocal count
            if not frame.f_code.co_filename.endswith(files):
                return None
            if event == "line":
                count += 1
                if count == moment:
                    os.kill(os.getpid(), signal.SIGKILL)
            return trace
        sys.settrace(trace)
        lw.save_actor(second, path)
        sys.settrace(None)
        return count

    def is_of(actor):
        found = lw.load_actor(path).state_dict()
        return all(torch.equal(found[name], value) for name, value in actor.state_dict().items())

    total = lines(0)
    lw.save_actor(first, path)
    killed = old = new = 0
    for k in range(moments):
        left = sweep(path)  # so that each save has as many lines
        assert len(left) <= 1
        child = os.fork()
        if child == 0:
            lines(1 + k * (total - 1) // (moments - 1))
            os._exit(0)
        status = os.waitpid(child, 0)[1]
        killed += os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL
        if is_of(first):
            old += 1
        else:
            assert is_of(second)
            new += 1
            lw.save_actor(first, path)
    lw.save_actor(first, path)
    assert is_of(first)
    print(killed, old, new, *sorted(os.listdir(os.path.dirname(path))))
"""


@pytest.mark.slow
def test_killed_at_any_line_of_saving_the_old_or_the_new_file_is_there(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    command = [sys.executable, "-W", "ignore", "-c", textwrap.dedent(KILLER), str(folder / "policy.zip"), "150"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    killed, old, new, *left = done.stdout.split()
    assert int(killed) == 150
    assert int(old) + int(new) == 150
    assert int(old) >= 50
    assert int(new) >= 1
    assert left == ["policy.zip"]


FULL = """
    import resource, signal, sys
    import torch
    import lw_torchrl as lw

    path = sys.argv[1]
    actor = lw.PlanConditionedActor(lw.load_plans("MT10"), width=64)
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
    try:
        lw.save_actor(actor, path)
    except OSError as error:
        print(error)
"""


def test_a_full_disk_is_an_error_and_the_old_file_stays(tmp_path):
    torch.manual_seed(0)
    actor, path = lw.PlanConditionedActor(lw.load_plans("MT10"), width=8), tmp_path / "policy.zip"
    lw.save_actor(actor, path)
    content = path.read_bytes()
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", textwrap.dedent(FULL), str(path)],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    assert f"checkpoint: {str(path)!r} cannot be written (File too large)" in done.stdout
    assert path.read_bytes() == content
    assert os.listdir(tmp_path) == ["policy.zip"]
