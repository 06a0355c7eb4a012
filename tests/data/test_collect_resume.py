"""collect_demonstrations in a folder that exists: interrupted, killed, finished, in use, or with other content."""

import importlib.metadata
import subprocess
import sys
import textwrap
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from collecting import STEPS, Evil, collect, interrupt_after, tree

from lw_torchrl._util.files import locked
from lw_torchrl._util.reproducibility import SIMULATORS, package_versions, version_changes
from lw_torchrl.data import DatasetError
from lw_torchrl.data.collect import EpisodeFiles
from lw_torchrl.data.dataset import read_metadata

# A process that starts the same call again and again and kills it: it imports once and forks for each attempt.
KILLER = """
    import os, random, signal, sys, time
    import torch
    from lw_torchrl.data import collect_demonstrations

    root, mode = sys.argv[1:]
    options = dict(episodes_per_task=3, seed=5, noise_scale=(0.0, 0.3), max_steps=14, progress=False)
    options |= dict(num_envs=2)  # few rows, so that episodes finish one after another

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
        # Before or after an os.replace, a later one in each attempt.
        real = os.replace
        for through in range(40):
            def prepare(left=[through // 2], after=through % 2):
                def replace(*args):
                    if not left[0] and not after:
                        die()
                    real(*args)
                    if not left[0]:
                        die()
                    left[0] -= 1
                os.replace = replace
            if not wait(attempt(prepare)):
                break
            kills += 1
        else:
            raise SystemExit("no attempt finished")
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


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["replace", "seed 1"])
def test_repeated_kills_do_not_change_the_dataset(dataset, tmp_path, mode):
    root = tmp_path / "demos"
    command = [sys.executable, "-W", "ignore", "-c", textwrap.dedent(KILLER), str(root), mode]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) >= (5 if mode == "replace" else 1)
    assert tree(root) == tree(dataset.root)


@pytest.fixture
def half_made(tmp_path, monkeypatch):
    """A folder with four of the six episodes."""
    root = tmp_path / "half"
    interrupt_after(monkeypatch, 4)
    with pytest.raises(KeyboardInterrupt):
        collect(root, num_envs=2)
    monkeypatch.undo()
    return root


def test_resuming_runs_only_the_missing_episodes(half_made, dataset, monkeypatch):
    with pytest.raises(DatasetError, match="unfinished"):
        read_metadata(half_made)
    assert len(list((half_made / ".partial").glob("*.npz"))) == 4
    written, put = [], EpisodeFiles.put
    monkeypatch.setattr(EpisodeFiles, "put", lambda *args: written.append(args) or put(*args))
    collect(half_made)
    assert len(written) == 2
    assert tree(half_made) == tree(dataset.root)


def test_a_damaged_episode_file_is_named_and_a_pickle_in_it_never_executed(half_made, dataset, tmp_path):
    path = sorted((half_made / ".partial").glob("*.npz"))[0]
    content, arrays = path.read_bytes(), {**np.load(path)}
    arrays["observation"] = np.array([Evil(tmp_path / "executed")] * STEPS, dtype=object)
    np.savez(path, allow_pickle=True, **arrays)
    for damaged in (path.read_bytes(), content[:-100]):
        path.write_bytes(damaged)
        with pytest.raises(DatasetError, match=rf"{path.name}' is corrupted"):
            collect(half_made)
    assert not (tmp_path / "executed").exists()
    path.unlink()
    collect(half_made)
    assert tree(half_made) == tree(dataset.root)


def test_a_finished_dataset_is_not_run_again(dataset, monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("no episode should run")

    before = tree(dataset.root)
    monkeypatch.setattr("lw_torchrl.data.collect.LanguageWorldEnv", refuse)
    assert collect(dataset.root) == dataset
    assert tree(dataset.root) == before


CHANGES = dict(tasks="reach", episodes_per_task=4, seed=6, noise_scale=0.1, noise_hold=3)
CHANGES |= dict(gripper_noise_factor=1.0, redraw_failures=True, max_steps=15)


@pytest.mark.parametrize("name", CHANGES)
def test_another_configuration_is_an_error_with_the_difference(dataset, name):
    before = tree(dataset.root)
    with pytest.raises(DatasetError, match=rf"another configuration \({name} \(.*, now .*\)\); ") as caught:
        collect(dataset.root, **{name: CHANGES[name]})
    assert not any(f"{other} (" in str(caught.value) for other in CHANGES if other != name)
    assert tree(dataset.root) == before


def test_a_folder_with_other_files_is_an_error_and_does_not_change(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "precious.csv").write_text("1,2,3")
    before = tree(tmp_path)
    with pytest.raises(DatasetError, match="not empty"):
        collect(tmp_path)
    assert tree(tmp_path) == before


def elsewhere(root):
    """Collect in another thread, while this one waits."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(collect, root).result()


def test_a_second_call_is_an_error_while_the_first_runs(dataset, tmp_path, monkeypatch):
    put, calls = EpisodeFiles.put, []

    def meanwhile(self, *args):
        if not calls:
            calls.append(True)
            with pytest.raises(DatasetError, match="root: another collect_demonstrations is writing"):
                elsewhere(tmp_path / "demos")
        put(self, *args)

    monkeypatch.setattr(EpisodeFiles, "put", meanwhile)
    collect(tmp_path / "demos")
    assert calls
    assert tree(tmp_path / "demos") == tree(dataset.root)


def test_a_finished_dataset_is_read_while_another_process_holds_the_lock(dataset):
    with locked(dataset.root, "root", folder=True):
        assert elsewhere(dataset.root) == dataset


def test_version_changes():
    now = package_versions()
    assert {*SIMULATORS, "torch", "numpy", "lw_torchrl"} <= now.keys()
    assert version_changes(now, now) == []
    assert version_changes({**now, "mujoco": "3.2.0"}, now) == [f"mujoco 3.2.0, now {now['mujoco']}"]


def test_episodes_of_two_simulators_are_never_mixed(half_made, monkeypatch):
    recorded, real = package_versions(), importlib.metadata.version
    with monkeypatch.context() as patch:
        other = lambda name: "9.9.9" if name == "mujoco" else real(name)  # noqa: E731
        patch.setattr("lw_torchrl._util.reproducibility.version", other)
        with pytest.raises(DatasetError, match=rf"another simulator \(mujoco {recorded['mujoco']}, now 9.9.9\)"):
            collect(half_made)
    assert collect(half_made).versions == recorded
