"""Recordings are never overwritten; killed runs, full disks and lost viewers keep what was written."""

import os
import signal
import subprocess
import sys
import time
import warnings
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
import torch
from recordings import Recording, listens, make_rollout

import lw_torchrl as lw
from lw_torchrl.record import RerunLogger
from lw_torchrl.record.rerun_logger import is_complete
from lw_torchrl.record.rollouts import new_recording
from lw_torchrl.record.viewer import LOCAL, free_port, readable, rerun_program


def run_script(script, *arguments):
    """Start a script that can import the modules of this folder."""
    code = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n{script}"
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.Popen([sys.executable, "-W", "ignore", "-c", code, *map(str, arguments)], env=environment)


def losses(path):
    return [row[0] for row in Recording(path).values("/metrics/loss", "Scalars:scalars")]


@contextmanager
def completed(path):
    """Yield a complete copy of a recording that was not closed."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with readable(path) as copy:
            yield copy


def test_a_recording_is_never_overwritten(tmp_path):
    path = tmp_path / "runs" / "a.rrd"
    loggers = [RerunLogger(path) for _ in range(3)]
    for number, logger in enumerate(loggers):
        logger.log_scalar("loss", number)
        logger.shutdown()
    assert [logger.path.name for logger in loggers] == ["a.rrd", "a-2.rrd", "a-3.rrd"]
    assert [losses(logger.path) for logger in loggers] == [[0.0], [1.0], [2.0]]


def test_a_new_recording_replaces_a_file_only_when_it_is_complete(tmp_path):
    path = tmp_path / "a.rrd"
    path.write_bytes(b"older")
    for error in (KeyError, None):
        with suppress(KeyError), new_recording(path) as logger:
            logger.log_scalar("loss", 1.0)
            if error is not None:
                raise error
        assert (path.read_bytes() == b"older") is (error is not None)
    assert losses(path) == [1.0]
    assert os.listdir(tmp_path) == ["a.rrd"]


FILLED = """
import resource
from lw_torchrl.record.rollouts import new_recording
from recordings import make_rollout
with new_recording(sys.argv[1]) as logger:
    logger.log_episode(make_rollout(400), task="push", objects={})
    logger.flush()
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), resource.RLIM_INFINITY))
    logger.log_episode(make_rollout(400), task="reach", objects={})
"""


@pytest.mark.slow
def test_a_full_disk_keeps_the_old_recording(tmp_path):
    path = tmp_path / "a.rrd"
    assert run_script(FILLED, path, 2**30).wait(120) == 0
    whole = path.read_bytes()
    for size in (len(whole) // 2, len(whole) - 10_000):  # Rerun may wait forever, but not always
        assert run_script(FILLED, path, size).wait(120) == 1
        assert path.read_bytes() == whole
        assert os.listdir(tmp_path) == ["a.rrd"]


def test_finishing_the_experiment_shuts_the_logger_down(tmp_path):
    # TorchRL's service backends do this instead of calling shutdown().
    logger = RerunLogger(tmp_path / "a.rrd")
    logger.log_scalar("loss", 1.0)
    logger.experiment.finish()
    assert not logger.is_alive
    assert losses(tmp_path / "a.rrd") == [1.0]


@pytest.mark.slow
def test_a_logger_shuts_down_when_the_process_exits(tmp_path):
    script = "from lw_torchrl.record import RerunLogger\nRerunLogger(sys.argv[1]).log_scalar('loss', 1.0)"
    assert run_script(script, tmp_path / "a.rrd").wait(120) == 0
    assert losses(tmp_path / "a.rrd") == [1.0]


KILLED = """
import time
from lw_torchrl.record import RerunLogger
from recordings import make_rollout
logger = RerunLogger(sys.argv[1])
logger.log_episode(make_rollout(40), task="push", objects={})
for number in range(10**6):
    logger.log_scalar("loss", number)
    time.sleep(0.01)
"""


@pytest.mark.slow
def test_a_killed_run_leaves_a_readable_recording(tmp_path):
    path = tmp_path / "a.rrd"
    process = run_script(KILLED, path)
    while not (path.exists() and path.stat().st_size):
        assert process.poll() is None
        time.sleep(0.05)
    time.sleep(4)
    process.send_signal(signal.SIGKILL)
    process.wait()
    with completed(path) as copy:
        assert is_complete(copy)
        assert len(losses(copy)) > 50
        assert {"/push/action", "/push/verdict"} <= Recording(copy).entities()
        assert Recording(copy).saved_tabs() == ["push", "Metrics"]


FULL = """
import resource, signal, time, warnings
from lw_torchrl.record import RerunLogger
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    with RerunLogger(sys.argv[1]) as logger:
        longest = 0.0
        for number in range(30_000):
            began = time.monotonic()
            logger.log_scalar("loss", number)
            if number % 5000 == 0:
                logger.state_dict()
            longest = max(longest, time.monotonic() - began)
assert "is incomplete" in " ".join(str(item.message) for item in caught)
assert longest < 3, longest
"""


@pytest.mark.slow
def test_a_full_disk_loses_the_end_of_the_recording_but_does_not_stop_the_program(tmp_path):
    path = tmp_path / "a.rrd"
    assert run_script(FULL, path).wait(120) == 0
    with completed(path) as copy:
        written = losses(copy)
    assert written == list(range(len(written)))
    assert len(written) > 1000


def test_a_connected_viewer_receives_everything(tmp_path):
    port, received = free_port(), tmp_path / "received.rrd"
    command = [rerun_program(), "--save", str(received), "--port", str(port), "--bind", LOCAL]
    viewer = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while not listens(port):
        assert viewer.poll() is None
        time.sleep(0.05)
    try:
        with RerunLogger(tmp_path / "a.rrd", connect=f"{LOCAL}:{port}") as logger:
            logger.log_scalar("loss", 1.0)
            logger.log_episode(make_rollout(), task="push", objects={})
        time.sleep(2)
    finally:
        viewer.send_signal(signal.SIGINT)
        viewer.wait(30)
    with completed(received) as copy:
        assert Recording(copy).entities() == Recording(tmp_path / "a.rrd").entities()
        assert Recording(copy).saved_tabs() == ["push", "Metrics"]
        assert len(Recording(copy).shown_tabs()) == 2


def test_seconds_per_step_are_those_of_the_suite(tmp_path):
    from lw_torchrl.suites.metaworld.environments import make_metaworld_env

    env = make_metaworld_env("reach")
    assert env.frame_skip * env.model.opt.timestep == pytest.approx(lw.suites.load_suite("metaworld").step_time)
    env.close()
    pytest.importorskip("gymnasium_robotics")
    env = lw.LanguageWorldEnv("fetch/reach", max_steps=3, seed=1)
    torch.manual_seed(0)
    rollout = env.rollout(3)[0]
    env.close()
    with RerunLogger(tmp_path / "a.rrd") as logger:
        lw.log_rollout(logger, rollout, seed=1, suite="fetch")
    recording = Recording(tmp_path / "a.rrd")
    seconds = recording.times("/fetch\\/reach-0/action", "Scalars:scalars", "time")
    assert [int(second) for second in seconds] == [0, 40_000_000, 80_000_000]
    assert "FAILED in 3 steps (0.12 s)" in recording.text("/fetch\\/reach-0/verdict")
    assert recording.blueprint()["time_panel", "fps"] == [25.0]
