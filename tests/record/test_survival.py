"""A logger that is killed, has no viewer, loses it, or fills the disk: what was written stays, and training goes on."""

from __future__ import annotations

import os
import random
import signal
import socket
import struct
import subprocess
import time
import warnings

import pytest
import torch
from logging_processes import LoggingProcesses
from recordings import Recording, make_rollout

from lw_torchrl.record import RerunLogger
from lw_torchrl.record.recording_file import LOCAL, binary, free_port, opened

MOMENTS = sorted(random.Random(seed).uniform(1.2, 3.5) for seed in range(5))


@pytest.fixture(scope="module")
def processes(tmp_path_factory):
    processes = LoggingProcesses(tmp_path_factory.mktemp("processes"))
    yield processes
    processes.close()


def copy_of(path):
    """What a viewer would open of a recording that was cut; whole, as rerun says itself."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with opened(path) as copy:
            assert "was not closed: its writer still writes, or was stopped" in str(caught[0].message)
            command = [binary(), "rrd", "verify", str(copy)]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            assert done.returncode == 0, done.stdout + done.stderr
            recording = Recording(copy)
            return recording, recording.tabs()


KILLED = """
import os, struct, time
from lw_torchrl.record import RerunLogger
from recordings import PLAN, make_objects, make_rollout

told = os.open(given["told"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
logger = RerunLogger(given["path"])
started, number, episodes = time.monotonic(), 0, 0
while True:
    logger.log_scalar("loss/bc", float(number), step=number)
    number += 1
    if time.monotonic() - started > episodes:
        rollout = make_rollout(40)
        logger.log_episode(rollout, task="push", objects=make_objects(rollout), plan=PLAN)
        episodes += 1
    os.write(told, struct.pack("ddd", time.monotonic(), number, episodes))
    time.sleep(0.002)
"""


@pytest.mark.parametrize("moment", [MOMENTS[0], *(pytest.param(one, marks=pytest.mark.slow) for one in MOMENTS[1:])])
def test_killed_at_any_moment_a_second_is_lost(processes, tmp_path, moment):
    path, told = tmp_path / "run.rrd", tmp_path / "told"
    child = processes.start(KILLED, path=str(path), told=str(told))
    deadline = time.monotonic() + 60
    while not (told.exists() and told.stat().st_size):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    time.sleep(moment)
    os.kill(child, signal.SIGKILL)
    assert processes.end()[0] == -signal.SIGKILL
    assert sorted(os.listdir(tmp_path)) == ["run.rrd", "told"]
    content = told.read_bytes()
    calls = list(struct.iter_unpack("ddd", content[: len(content) // 24 * 24]))
    numbers, episodes = next((n, e) for t, n, e in reversed(calls) if t <= calls[-1][0] - 1.0)
    recording, tabs = copy_of(path)
    found = recording.times("/metrics/loss/bc", "Scalars:scalars", "global_step")
    assert found == list(range(len(found)))
    assert len(found) >= numbers > 0
    assert ("/push/action" if episodes == 1 else f"/push-{int(episodes)}/action") in recording.entities()
    assert "Metrics" in tabs
    assert len(tabs) - 1 >= episodes > 0


def test_an_exception_keeps_the_file(tmp_path):
    def interrupted():
        with RerunLogger(tmp_path / "a.rrd") as logger:
            logger.log_episode(make_rollout(), task="push", objects={})
            logger.log_scalar("loss", 1.0)
            raise KeyError("mine")

    with pytest.raises(KeyError, match="mine"):
        interrupted()
    assert {"/push/action", "/metrics/loss"} <= Recording(tmp_path / "a.rrd").entities()


FORGOTTEN = """
from lw_torchrl.record import RerunLogger
import atexit
RerunLogger(given["path"]).log_scalar("loss", 1.0)
atexit._run_exitfuncs()
"""


def test_a_logger_nobody_shuts_down_ends_with_the_process(processes, tmp_path):
    processes.start(FORGOTTEN, path=str(tmp_path / "a.rrd"))
    assert processes.end() == (0, "")
    assert Recording(tmp_path / "a.rrd").values("/metrics/loss", "Scalars:scalars") == [[1.0]]


FULL = """
import os, resource, signal, time, warnings
from lw_torchrl.record import RerunLogger

if "limit" in given:
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (given["limit"],) * 2)
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    longest = 0.0
    with RerunLogger(given["path"]) as logger:
        for number in range(60_000):
            began = time.monotonic()
            logger.log_scalar("loss/bc", float(number), step=number)
            if number % 500 == 499:
                logger.flush()
            longest = max(longest, time.monotonic() - began)
        state = logger.state_dict()
        logger.log_hparams({"lr": 1})
assert state["local"]["counters"] == {"/metrics/loss/bc": 60_000}
(warning,) = caught
assert f"recording {given['path']!r} takes nothing more ({given['reason']}); what was" in str(warning.message), warning
print("longest", longest)
"""


def test_a_limit_on_files(processes, tmp_path):
    processes.start(FULL, path=str(tmp_path / "a.rrd"), limit=200_000, reason="File too large")
    status, said = processes.end()
    assert status == 0, said
    readable(tmp_path / "a.rrd")


def test_a_full_disk(processes, tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=200k", "tmpfs", disk], capture_output=True).returncode:
        pytest.skip("mounting a small disk is not allowed here")
    try:
        processes.start(FULL, path=str(disk / "a.rrd"), reason="No space left on device")
        status, said = processes.end()
        assert status == 0, said
        readable(disk / "a.rrd")
    finally:
        subprocess.run(["umount", "-l", disk], check=True)


def readable(path):
    """What was written before the end is there, in order, with the layout."""
    recording, tabs = copy_of(path)
    found = recording.times("/metrics/loss/bc", "Scalars:scalars", "global_step")
    assert found == list(range(len(found)))
    assert len(found) > 1000
    assert tabs == ["Metrics"]


def log_without_viewer(logger):
    """Log, checkpoint and shut down; the warnings, and the longest call's seconds."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        longest = 0.0
        for number in range(300):
            began = time.monotonic()
            logger.log_scalar("loss", float(number))
            if number % 100 == 0:
                logger.state_dict()
            longest = max(longest, time.monotonic() - began)
        began = time.monotonic()
        logger.shutdown()
    return [str(one.message) for one in caught], max(longest, time.monotonic() - began)


def test_no_viewer_at_the_start(tmp_path):
    address = f"{LOCAL}:{free_port()}"
    began = time.monotonic()
    with pytest.warns(UserWarning, match=f"viewer at rerun.http://{address}/proxy does not answer .* goes on in '"):
        logger = RerunLogger(tmp_path / "a.rrd", connect=address)
    opening = time.monotonic() - began
    said, longest = log_without_viewer(logger)
    assert said == []
    assert opening < 4  # rerun's own sink waits 5 s, at the start and at the end
    assert longest < 4
    assert len(Recording(tmp_path / "a.rrd").values("/metrics/loss", "Scalars:scalars")) == 300


def test_no_viewer_and_no_file():
    with pytest.warns(UserWarning, match="does not answer .*; nothing more is recorded"):
        logger = RerunLogger(connect=f"http://{LOCAL}:{free_port()}".removeprefix("http://"))
    assert log_without_viewer(logger)[0] == []


def test_what_listens_is_no_viewer(tmp_path):
    # It takes connections, as a viewer that hangs does, and never answers.
    with socket.create_server((LOCAL, 0)) as silent:
        logger = RerunLogger(tmp_path / "a.rrd", connect=f"{LOCAL}:{silent.getsockname()[1]}")
        said, longest = log_without_viewer(logger)
    assert len(said) == 1
    assert longest < 4
    assert len(Recording(tmp_path / "a.rrd").values("/metrics/loss", "Scalars:scalars")) == 300


def listens(port):
    with socket.socket() as one:
        return not one.connect_ex((LOCAL, port))


@pytest.fixture
def receiver(tmp_path):
    """What stands in for a viewer: rerun receiving at a port, without a window, into a file."""
    port, file = free_port(), tmp_path / "received.rrd"
    command = [binary(), "--save", str(file), "--port", str(port), "--bind", LOCAL]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    while not listens(port):
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.05)
    yield process, f"{LOCAL}:{port}", file
    process.kill()
    process.wait()


def wait_until_it_rests(file):
    """What was received is written a little later."""
    size, deadline = -1, time.monotonic() + 30
    while (now := file.stat().st_size if file.exists() else 0) != size:
        assert time.monotonic() < deadline
        size = now
        time.sleep(1.5)


@pytest.mark.parametrize("beside", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_viewer_gets_everything(tmp_path, receiver, beside):
    process, address, file = receiver
    logger = RerunLogger(tmp_path / "a.rrd" if beside else None, connect=address)
    assert logger.path is None or logger.path.exists()
    logger.log_scalar("loss/bc", torch.tensor([1.0, 2.0]))
    logger.log_episode(make_rollout(), task="push", objects={})
    logger.flush()
    logger.log_hparams({"lr": 1})
    logger.shutdown(timeout=30)
    wait_until_it_rests(file)
    process.send_signal(signal.SIGINT)
    process.wait(30)
    recording, tabs = copy_of(file)
    assert {"/metrics/loss/bc", "/push/action", "/hparams"} <= recording.entities()
    assert recording.values("/metrics/loss/bc", "Scalars:scalars") == [[1.0, 2.0]]
    assert tabs == ["push", "Metrics", "Hyperparameters"]
    if beside:
        assert recording.entities() == Recording(tmp_path / "a.rrd").entities()


def test_a_viewer_killed_half_way(tmp_path, receiver):
    process, address, _ = receiver
    logger = RerunLogger(tmp_path / "a.rrd", connect=address)
    logger.log_scalar("loss", -1.0)
    logger.flush()
    process.kill()
    process.wait()
    said, longest = log_without_viewer(logger)
    assert len(said) == 1
    assert f"the viewer at rerun+http://{address}/proxy is gone (" in said[0]
    assert f"the recording goes on in {str(tmp_path / 'a.rrd')!r}" in said[0]
    assert longest < 4
    assert len(Recording(tmp_path / "a.rrd").values("/metrics/loss", "Scalars:scalars")) == 301


@pytest.mark.parametrize("address", ["", "http://127.0.0.1:9876", "127.0.0.1:99999", "rerun://host/elsewhere", "a b"])
def test_wrong_addresses_are_named(address):
    with pytest.raises(ValueError, match=r"connect must be an address like '127\.0\.0\.1:9876'"):
        RerunLogger(connect=address)
    with pytest.raises(ValueError, match="give path, a file to write, or connect"):
        RerunLogger()
