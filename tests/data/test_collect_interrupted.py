"""Collecting that was stopped or killed carries on, and gives the same dataset."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap

import numpy as np
import pytest
from collecting import STEPS, collect, interrupt_after, tree

from lw_torchrl.data import DatasetError
from lw_torchrl.data.collect import EpisodeFiles
from lw_torchrl.data.dataset import read_metadata


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return collect(tmp_path_factory.mktemp("made") / "demos")


# One process that starts the same call again and again and kills it: importing once, forking for each try.
KILLER = """
    import os, random, signal, sys, time
    import torch
    from lw_torchrl.data import collect_demonstrations

    root, mode = sys.argv[1:]
    options = dict(episodes_per_task=3, seed=5, noise_scale=(0.0, 0.3), max_steps=14, progress=False)
    options |= dict(num_envs=2)  # few rows, so that episodes are put away one after another

    def die():
        os.kill(os.getpid(), signal.SIGKILL)

    def attempt(prepare):
        child = os.fork()
        if child == 0:
            try:
                prepare()
                collect_demonstrations(("push", "reach"), root=root, **options)
            except BaseException as error:
                print(repr(error), file=sys.stderr)
                os._exit(1)
            os._exit(0)
        return child

    def wait(child):
        status = os.waitpid(child, 0)[1]
        assert not os.WIFEXITED(status) or os.WEXITSTATUS(status) == 0, status
        return os.WIFSIGNALED(status)

    kills = 0
    if mode == "replace":
        # At an os.replace, before or after it, which one moves on with the tries.
        real = os.replace
        for after in (False, True) * 2:
            def prepare(after=after):
                def replace(*args):
                    if not after:
                        die()
                    real(*args)
                    die()
                os.replace = replace
            kills += wait(attempt(prepare))
        for through in range(20):
            def prepare(through=through):
                left = [through]
                def replace(*args):
                    if not left[0]:
                        die()
                    left[0] -= 1
                    real(*args)
                os.replace = replace
            if not wait(attempt(prepare)):
                break
            kills += 1
        else:
            raise SystemExit("it never ended")
    else:
        draw = random.Random(mode)
        for _ in range(8):
            child = attempt(lambda: None)
            time.sleep(draw.uniform(0.0, 1.0))
            os.kill(child, signal.SIGKILL)
            kills += wait(child)
        wait(attempt(lambda: None))
    print(kills)
"""


@pytest.mark.parametrize("mode", ["replace", pytest.param("seed 1", marks=pytest.mark.slow)])
def test_killed_again_and_again_it_gives_the_same_dataset(made, tmp_path, mode):
    root = tmp_path / "demos"
    command = [sys.executable, "-W", "ignore", "-c", textwrap.dedent(KILLER), str(root), mode]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) >= (5 if mode == "replace" else 1)
    assert tree(root) == tree(made.root)


@pytest.fixture
def half_made(tmp_path, monkeypatch):
    """A folder in which four of the six episodes are done."""
    root = tmp_path / "half"
    interrupt_after(monkeypatch, 4)
    with pytest.raises(KeyboardInterrupt):
        collect(root, num_envs=2)
    monkeypatch.undo()
    return root


def test_an_interrupted_dataset_carries_on_without_doing_episodes_twice(half_made, made, monkeypatch):
    with pytest.raises(DatasetError, match="unfinished"):
        read_metadata(half_made)
    shards = list((half_made / ".partial").glob("*.npz"))
    assert len(shards) == 4
    done = []
    put = EpisodeFiles.put
    monkeypatch.setattr(
        EpisodeFiles, "put", lambda self, task, episode, steps: (done.append(task), put(self, task, episode, steps))
    )
    collect(half_made)
    assert len(done) == 2
    assert tree(half_made) == tree(made.root)


def test_a_damaged_episode_file_is_named(half_made, made):
    path = sorted((half_made / ".partial").glob("*.npz"))[0]
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(DatasetError, match=rf"{path.name}' is damaged .*; delete this file to run it again"):
        collect(half_made)
    path.unlink()
    collect(half_made)
    assert tree(half_made) == tree(made.root)


def test_no_pickle_in_an_episodes_file_is_ever_executed(half_made, tmp_path):
    class Evil:
        def __reduce__(self):
            return (os.mkdir, (str(tmp_path / "executed"),))

    path = sorted((half_made / ".partial").glob("*.npz"))[0]
    with np.load(path) as file:
        arrays = {key: file[key] for key in file.files}
    arrays["observation"] = np.array([Evil()] * STEPS, dtype=object)
    np.savez(path, allow_pickle=True, **arrays)
    with pytest.raises(DatasetError, match="is damaged"):
        collect(half_made)
    assert not (tmp_path / "executed").exists()
