"""The viewer: opened at a tab and a step, in a browser, and drawing a picture."""

import signal
import subprocess
import sys
import time
import urllib.request
from contextlib import contextmanager
from http.client import HTTPConnection
from types import SimpleNamespace
from urllib.parse import parse_qs, urlsplit

import pytest
import torch
from recordings import Recording, listens, skip_without_graphics_driver
from tensordict import TensorDict

from lw_torchrl._util import files
from lw_torchrl.record import RerunLogger, open_viewer, viewer
from lw_torchrl.record.viewer import find_recordings, rerun_process


def write(path, steps=20, episodes=1):
    """Write a recording of a training and of episodes."""
    rollout = TensorDict({"observation": torch.rand(steps, 39), "action": torch.rand(steps, 4)}, [steps])
    rollout["next", "success"] = torch.arange(steps)[:, None] >= steps // 2
    with RerunLogger(path) as logger:
        for _ in range(episodes):
            logger.log_episode(rollout, task="reach", objects={"puck": rollout["observation"][:, 4:7]})
        logger.log_scalar("loss/bc", 1.0)
    return logger.path


REMEDIES = {
    "thread main panicked at Failed to get render context": "apt-get install libvulkan1 mesa-vulkan-drivers",
    "Error: neither WAYLAND_DISPLAY nor DISPLAY is set.": "--screenshot",
    "something else": "something else",
}


@pytest.mark.parametrize(("output", "message"), REMEDIES.items())
@pytest.mark.parametrize("screenshot", [None, "a.png"])
def test_error_of_a_failing_viewer_names_the_remedy(tmp_path, monkeypatch, output, message, screenshot):
    write(tmp_path / "a.rrd")
    script = tmp_path / "viewer"
    script.write_text(f"#!/bin/sh\necho '{output}'\nexit 102\n")
    script.chmod(0o755)
    monkeypatch.setenv("RERUN_CLI_PATH", str(script))
    with pytest.raises(RuntimeError, match=message):
        open_viewer(tmp_path / "a.rrd", None if screenshot is None else tmp_path / screenshot)
    assert not (tmp_path / "a.png").exists()


def test_missing_or_unreadable_recordings_and_unknown_episodes_are_errors(tmp_path):
    write(tmp_path / "a.rrd")
    (tmp_path / "empty").mkdir()
    for path in ("c.rrd", "empty"):
        with pytest.raises(FileNotFoundError, match=path):
            open_viewer(tmp_path / path)
    with pytest.raises(ValueError, match=r"episode .*'reach', 'Metrics'"):
        open_viewer(tmp_path / "a.rrd", episode="push")
    for content in (b"", b"something else"):
        (tmp_path / "b.rrd").write_bytes(content)
        with pytest.warns(UserWarning, match="was not closed"), pytest.raises(ValueError, match="damaged"):
            open_viewer(tmp_path / "b.rrd")


FORGED = {
    "cut before the end": lambda content: content[: len(content) // 2] + content[-32:],
    "cut before a forged end": lambda content: content[: len(content) // 3] + b"RRF2FOOT" + b"x" * 20,
    "header and end": lambda content: content[:12] + b"RRF2FOOT",
    "a zeroed page": lambda content: content[:1000] + bytes(2000) + content[3000:],
    "a size of exabytes": lambda content: content[:-20] + b"\xff" * 7 + content[-13:],
}


@pytest.mark.parametrize("forge", FORGED.values(), ids=FORGED)
def test_forged_recordings_are_called_damaged(tmp_path, forge):
    path = write(tmp_path / "a.rrd")
    path.write_bytes(forge(path.read_bytes()))
    with pytest.raises(ValueError, match=r"a\.rrd' .* damaged"):
        open_viewer(path)


def test_a_recording_that_is_never_read_to_its_end_is_damaged(tmp_path, monkeypatch):
    path = write(tmp_path / "a.rrd")
    monkeypatch.setattr(files, "_SECONDS", 1)
    monkeypatch.setattr(viewer, "_READ", "while True: pass")
    with pytest.raises(ValueError, match=r"a\.rrd' is damaged .*limits of 1 s"):
        open_viewer(path)


@pytest.mark.slow
def test_web_viewer_is_served_on_this_machine_until_interrupted(tmp_path):
    path = write(tmp_path / "a.rrd")
    code = f"from lw_torchrl.record import open_viewer; open_viewer({str(path)!r}, episode='Metrics', web_port=0)"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as process:
        address = urlsplit(process.stdout.readline().strip())
        server = urlsplit(parse_qs(address.query)["url"][0].removeprefix("rerun+"))
        while not (listens(address.port) and listens(server.port)):
            assert process.poll() is None
            time.sleep(0.1)
        get = urllib.request.build_opener(urllib.request.ProxyHandler({})).open
        with get(f"http://{address.netloc}/", timeout=20) as page:
            assert b"re_viewer" in page.read()
        for port, path in ((address.port, "/"), (server.port, "/proxy")):
            statuses = []
            for host in (f"127.0.0.1:{port}", f"localhost:{port}", f"evil.example:{port}", "127.0.0.1", ""):
                connection = HTTPConnection("127.0.0.1", port, timeout=20)
                connection.request("GET", path, headers={"Host": host})
                statuses.append(connection.getresponse().status)
                connection.close()
            assert [status == 403 for status in statuses] == [False, False, True, True, True]
        assert address.hostname == server.hostname == "127.0.0.1"
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
    assert not listens(address.port)


@pytest.fixture
def seen(monkeypatch):
    """Run open_viewer's window without a screen; return its cursors, and the views of its front tab."""
    seen = {}

    @contextmanager
    def headless(*arguments):
        with rerun_process(*arguments, "--headless") as (process, output):
            yield SimpleNamespace(poll=process.poll, wait=process.poll), output

    go_to = viewer._go_to

    def go_and_look(client, openings):
        go_to(client, openings)
        state = client.get_state()
        seen["cursors"] = sorted(recording.current_time for recording in state.recordings)
        seen["views"] = {view.name for view in state.views}

    monkeypatch.setattr(viewer, "rerun_process", headless)
    monkeypatch.setattr(viewer, "_go_to", go_and_look)
    return seen


def test_all_recordings_of_a_folder_open_at_their_own_steps(tmp_path, seen):
    runs = [write(tmp_path / "a.rrd"), write(tmp_path / "a.rrd", steps=30)]
    assert find_recordings(tmp_path) == runs == [tmp_path / "a.rrd", tmp_path / "a-2.rrd"]
    with skip_without_graphics_driver():
        open_viewer(runs)
    assert seen["cursors"] == [11, 16]
    assert "Verdict" in seen["views"]


@pytest.mark.parametrize(
    ("episodes", "episode", "view"), [(2, "reach-2", "Verdict"), (2, "metri", "loss"), (0, "Metrics", "loss")]
)
def test_a_tab_is_brought_to_the_front(tmp_path, seen, episodes, episode, view):
    write(tmp_path / "a.rrd", episodes=episodes)
    with skip_without_graphics_driver():
        open_viewer(tmp_path / "a.rrd", episode=episode, step=0)
    assert view in seen["views"]
    assert seen["cursors"] == [0]


def test_a_truncated_recording_is_shown_with_a_warning(tmp_path, seen):
    content = write(tmp_path / "a.rrd", steps=400).read_bytes()
    (tmp_path / "a.rrd").write_bytes(content[: int(0.9 * len(content))])
    with skip_without_graphics_driver(), pytest.warns(UserWarning, match="was not closed"):
        open_viewer(tmp_path / "a.rrd")
    assert "Verdict" in seen["views"]


def test_episodes_side_by_side_come_before_their_own_tabs(tmp_path):
    rollout = TensorDict({"observation": torch.rand(9, 39), "action": torch.rand(9, 4)}, [9])
    with RerunLogger(tmp_path / "a.rrd") as logger:
        names = [logger.log_episode(rollout, task="reach", objects={}) for _ in range(2)]
        logger.compare(names)
        for wrong in (["reach"], ["reach", "push"]):
            with pytest.raises(ValueError, match="names"):
                logger.compare(wrong)
    recording = Recording(tmp_path / "a.rrd")
    assert recording.saved_tabs() == [*recording.shown_tabs()] == ["Side by side", "reach", "reach-2"]
    assert recording.shown_tabs()["Side by side"] == ["reach", "reach-2"]
