"""Episodes in worker processes: the same bits for every number of workers, and no process is left after a fault."""

import os
import re
import signal
import subprocess
import sys
import threading
import time
import warnings
from contextlib import closing
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

import lw_torchrl as lw
from lw_torchrl._util import workers as workers_module
from lw_torchrl._util.workers import split, spread
from lw_torchrl.data import collect_demonstrations
from lw_torchrl.evaluation import evaluate

PLANS = lw.load_plans("MT10")
TASKS = ("push", "reach")
EPISODES = {"push": range(3), "reach": range(2)}


def lives(pid):
    """Whether a process runs; a zombie does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def wait_for(condition, seconds=60.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.02)


def tree(root):
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


@given(st.dictionaries(st.sampled_from("abcdef"), st.lists(st.integers(), max_size=150)), st.integers(1, 20))
def test_parts_hold_each_episode_once_and_are_of_equal_size(episodes, workers):
    parts, together = split(episodes, workers, 64), {}
    for part in parts:
        for task, listed in part.items():
            together.setdefault(task, []).extend(listed)
    assert together == {task: listed for task, listed in episodes.items() if listed}
    sizes = [sum(map(len, part.values())) for part in parts]
    assert not sizes or (0 < max(sizes) <= 64 and max(sizes) - min(sizes) <= 1)
    assert (len(parts) >= min(workers, sum(sizes)) and len(parts) % workers == 0) or len(parts) == sum(sizes)


def test_parts_hold_few_tasks():
    parts = split({"a": range(2), "b": range(2), "c": range(4)}, 2, 64)
    assert parts == [{"a": [0, 1], "b": [0, 1]}, {"c": [0, 1, 2, 3]}]
    assert [len(part) for part in split(dict.fromkeys("abcdef", range(64)), 3, 64)] == [1] * 6


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        pytest.param(dict(tasks="push", noise_scale=(0.0, 1.0), redraw_failures=True, max_steps=90), id="redrawn"),
        pytest.param(dict(tasks=("drawer-open", *TASKS), policy="noisy-60", max_steps=12, num_envs=3), id="segments"),
    ],
)
def test_the_number_of_workers_changes_no_byte_of_a_dataset(options, tmp_path):
    for workers in (1, 2, 3):
        how = {"episodes_per_task": 4, "seed": 5, "workers": workers, "progress": False, **options}
        dataset = collect_demonstrations(root=tmp_path / str(workers), **how)
    if "redraw_failures" in options:
        assert dataset.attempts["push"] > 4, "some episodes are replaced"
    assert tree(tmp_path / "2") == tree(tmp_path / "3") == tree(tmp_path / "1")


@pytest.mark.slow
def test_the_number_of_workers_changes_no_bit_of_a_result():
    torch.manual_seed(0)
    actor = lw.PlanConditionedActor(PLANS)
    results, seen = [], []
    how = {"max_steps": 30, "record_actions": True, "also_record": ["qaf"], "attribute": True, "progress": False}
    how |= {"evaluator": lw.transforms.CorruptQAF(PLANS, flip=0.2, seed=1), "episodes_per_task": 3, "seed": 7}
    for workers in (1, 2, 3):
        episodes = []
        results.append(evaluate(actor, tasks=TASKS, workers=workers, on_episode=episodes.append, **how))
        seen.append({(e.task, e.episode): e.steps["qaf"] for e in episodes})
    for result, qaf in zip(results[1:], seen[1:], strict=True):
        assert result == results[0]
        pairs = zip(result.episodes, results[0].episodes, strict=True)
        assert all(torch.equal(one.actions, other.actions) for one, other in pairs)
        assert qaf.keys() == seen[0].keys()
        assert all(torch.equal(values, seen[0][key]) for key, values in qaf.items())


def where(part, on_steps):
    for task, listed in part.items():
        for episode in listed:
            on_steps(7)
            yield task, episode, os.getpid()


def run_where(workers=None, max_steps=1, run=where, **options):
    steps = []
    items = list(spread(run, EPISODES, steps.append, workers=workers, max_steps=max_steps, largest=64, **options))
    assert sorted(item[:2] for item in items) == [("push", 0), ("push", 1), ("push", 2), ("reach", 0), ("reach", 1)]
    assert sum(steps) == 35
    return {pid for *_, pid in items}


def test_little_work_stays_in_this_process(monkeypatch):
    monkeypatch.setattr(workers_module, "available_cores", lambda: 2)
    assert run_where() == run_where(max_steps=100_000, alone=True) == {os.getpid()}
    assert os.getpid() not in run_where(max_steps=100_000)


def test_a_worker_starts_no_workers():
    def run(part, on_steps):
        items = spread(where, {"push": range(9)}, print, workers=None, max_steps=100_000, largest=64)
        assert {pid for *_, pid in items} == {os.getpid()}
        return where(part, on_steps)

    assert os.getpid() not in run_where(2, run=run)


def test_what_cannot_be_pickled_stays_in_this_process_or_is_an_error(monkeypatch):
    monkeypatch.setattr(workers_module, "available_cores", lambda: 2)
    lock = threading.Lock()

    def run(part, on_steps):
        with lock:
            return list(where(part, on_steps))

    assert run_where(max_steps=100_000, run=run) == {os.getpid()}
    with pytest.raises(ValueError, match=r"workers=2 requires a policy that can be pickled \(TypeError: .*lock"):
        run_where(2, run=run)


def test_functions_stay_in_this_process_unless_workers_is_given(monkeypatch, tmp_path):
    monkeypatch.setattr(workers_module, "START", 1)
    calls = []

    def still(state):
        calls.append(os.getpid())
        return state.set("action", torch.zeros(*state.batch_size, 4))

    run = dict(tasks=TASKS, episodes_per_task=1, seed=0, max_steps=3, progress=False)
    evaluate(still, **run)
    collect_demonstrations(root=tmp_path / "demos", policy=still, behaviour="still", **run)
    assert calls == [os.getpid()] * 6
    evaluate(still, workers=2, **run)
    assert len(calls) == 6


SCRIPT = """
import torch, lw_torchrl as lw
print("once", flush=True)
class Still(torch.nn.Module):
    def forward(self, state):
        return state.set("action", torch.zeros(*state.batch_size, 4))
run = dict(episodes_per_task=2, seed=0, max_steps=5, progress=False)
results = [lw.evaluate(Still(), tasks=["push", "reach"], workers=workers, **run) for workers in (1, 2)]
print(results[0] == results[1])
"""


@pytest.mark.slow
def test_a_script_without_a_guard_runs_once(tmp_path):
    """The policy's class is the script's own, and workers do not import the script."""
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=240)
    assert (done.stdout, done.returncode) == ("once\nTrue\n", 0), done.stderr


def test_an_error_keeps_its_type_and_names_the_episodes():
    class Broken(nn.Module):
        def forward(self, state):
            return state.set("action", torch.full((*state.batch_size, 4), torch.nan))

    with pytest.raises(ValueError, match="its action is NaN, in task 'push'") as caught:
        evaluate(Broken(), tasks="push", episodes_per_task=4, seed=0, max_steps=3, workers=2, progress=False)
    (note,) = caught.value.__notes__
    assert re.fullmatch("raised in a worker process, in one of these episodes: push (0, 1|2, 3)", note)


def test_warnings_are_issued_in_this_process():
    def run(part, on_steps):
        warnings.warn(f"a fault in {[*part]}", UserWarning, stacklevel=1)
        return where(part, on_steps)

    with pytest.warns(UserWarning, match="a fault in") as caught:
        run_where(2, run=run)
    assert {str(warning.message) for warning in caught} == {"a fault in ['push']", "a fault in ['reach']"}


def marking(folder, push=100.0, reach=100.0):
    """Return a function that leaves a file with its worker's process id, and works for some seconds."""

    def run(part, on_steps):
        (folder / str(os.getpid())).touch()
        time.sleep(push if "push" in part else reach)
        return where(part, on_steps)

    return run


def marked(folder):
    return [int(path.name) for path in folder.iterdir()]


def test_a_killed_worker_is_an_error_and_ends_the_others(tmp_path):
    def kill():
        wait_for(lambda: len(marked(tmp_path)) == 2)
        os.kill(marked(tmp_path)[0], signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    with pytest.raises(RuntimeError, match=r"a worker process was killed, .*: repeat the call"):
        run_where(2, run=marking(tmp_path))
    killer.join()
    wait_for(lambda: not any(map(lives, marked(tmp_path))), 10)


def test_an_abandoned_iteration_ends_the_workers(tmp_path):
    options = {"workers": 2, "max_steps": 1, "largest": 64}
    with closing(spread(marking(tmp_path, reach=1.0), {"reach": [0], "push": [0]}, print, **options)) as items:
        assert next(items)[0] == "reach"
        wait_for(lambda: len(marked(tmp_path)) == 2)
    wait_for(lambda: not any(map(lives, marked(tmp_path))), 10)


PROGRAM = """
import os, pathlib, time
from lw_torchrl._util.workers import spread

def run(part, on_steps):
    (pathlib.Path(FOLDER) / str(os.getpid())).touch()
    time.sleep(100)
    return []

list(spread(run, {"push": range(6)}, print, workers=2, max_steps=1, largest=64))
"""


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_no_worker_survives_this_process(number, tmp_path):
    """Ctrl-C reaches all processes of a terminal, and only this one prints a traceback."""
    command = [sys.executable, "-c", PROGRAM.replace("FOLDER", repr(str(tmp_path)))]
    main = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    wait_for(lambda: len(marked(tmp_path)) == 2)
    (os.killpg if number == signal.SIGINT else os.kill)(main.pid, number)
    error = main.communicate(timeout=60)[1]
    wait_for(lambda: not any(map(lives, marked(tmp_path))), 10)
    assert main.returncode != 0
    assert error.count("Traceback") == (number == signal.SIGINT), error


@pytest.mark.slow
def test_an_interrupted_collection_resumes_with_the_same_bytes(tmp_path):
    how = dict(episodes_per_task=4, seed=5, max_steps=100, progress=False)
    expected = collect_demonstrations(TASKS, root=tmp_path / "whole", workers=1, **how)
    folder = tmp_path / "interrupted"

    def written():
        return len(list((folder / ".partial").glob("*.npz")))

    def interrupt():
        wait_for(written)
        signal.raise_signal(signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    thread.start()
    with pytest.raises(KeyboardInterrupt):  # with one environment in each worker, episodes finish one after another
        collect_demonstrations(TASKS, root=folder, workers=2, num_envs=1, **how)
    thread.join()
    assert 0 < written() < 8
    assert collect_demonstrations(TASKS, root=folder, workers=2, **how).episodes == expected.episodes
    assert tree(folder) == tree(tmp_path / "whole")
