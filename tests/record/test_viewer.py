"""The viewer: opened at a tab and a step, and made to draw."""

from __future__ import annotations

import stat
import warnings
from contextlib import contextmanager
from types import SimpleNamespace

import pytest
import torch
from recordings import Recording
from tensordict import TensorDict

from lw_torchrl.record import RerunLogger, open_viewer, viewer
from lw_torchrl.record.viewer import find_recordings, readable, rerun_process


def write(path, steps=20, episodes=1):
    """A recording of a training and of episodes."""
    rollout = TensorDict({"observation": torch.rand(steps, 39), "action": torch.rand(steps, 4)}, [steps])
    rollout["next", "success"] = torch.arange(steps)[:, None] >= steps // 2
    with RerunLogger(path) as logger:
        for _ in range(episodes):
            logger.log_episode(rollout, task="reach", objects={"puck": rollout["observation"][:, 4:7]})
        logger.log_scalar("loss/bc", 1.0)
    return logger.path


def fake_viewer(tmp_path, monkeypatch, prints, code):
    script = tmp_path / "viewer"
    script.write_text(f"#!/bin/sh\necho '{prints}'\nexit {code}\n")
    script.chmod(script.stat().st_mode | stat.S_IEXEC)
    monkeypatch.setenv("RERUN_CLI_PATH", str(script))


@pytest.mark.parametrize(
    ("prints", "message"),
    [
        ("thread main panicked at Failed to get render context", "apt-get install libvulkan1 mesa-vulkan-drivers"),
        ("Error: neither WAYLAND_DISPLAY nor DISPLAY is set.", "there is no screen"),
        ("something else", "ended with an error:\nsomething else"),
    ],
)
@pytest.mark.parametrize("screenshot", [None, "a.png"])
def test_a_failing_viewer_says_what_to_do(tmp_path, monkeypatch, prints, message, screenshot):
    write(tmp_path / "a.rrd")
    fake_viewer(tmp_path, monkeypatch, prints, 102)
    with pytest.raises(RuntimeError, match=message):
        open_viewer(tmp_path / "a.rrd", None if screenshot is None else tmp_path / screenshot)
    assert not (tmp_path / "a.png").exists()


def test_wrong_arguments_of_the_viewer(tmp_path):
    write(tmp_path / "a.rrd")
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match="there is no recording"):
        open_viewer(tmp_path / "c.rrd")
    with pytest.raises(FileNotFoundError, match="holds no recording"):
        open_viewer(tmp_path / "empty")
    with pytest.raises(ValueError, match="episode must be one of 'reach', 'Metrics', got 'push'"):
        open_viewer(tmp_path / "a.rrd", episode="push")
    for content in (b"", b"something else"):
        (tmp_path / "b.rrd").write_bytes(content)
        with pytest.raises(ValueError, match="is not a rerun recording, or nothing was written"), quietly():
            open_viewer(tmp_path / "b.rrd")


def test_a_folder_stands_for_its_recordings(tmp_path):
    files = [write(tmp_path / "a.rrd") for _ in range(2)]
    assert find_recordings(tmp_path) == files == [tmp_path / "a.rrd", tmp_path / "a-2.rrd"]


@contextmanager
def quietly():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that the recording was not closed
        yield


@contextmanager
def needing_a_driver():
    try:
        yield
    except RuntimeError as error:
        if "no graphics driver" in str(error):
            pytest.skip("no graphics driver")
        raise


def test_a_picture_is_taken_where_the_machine_can_draw(tmp_path):
    write(tmp_path / "a.rrd")
    with needing_a_driver():
        open_viewer(tmp_path / "a.rrd", tmp_path / "a.png", "800x600", step=10)
    assert (tmp_path / "a.png").read_bytes()[16:24] == (800).to_bytes(4, "big") + (600).to_bytes(4, "big")


@pytest.fixture
def seen(monkeypatch):
    """What open_viewer shows in a window, which is one without a screen: cursors, and the views of the tab in front."""
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


def test_several_runs_open_at_their_own_steps(tmp_path, seen):
    runs = [write(tmp_path / "a.rrd"), write(tmp_path / "b.rrd", steps=30)]
    with needing_a_driver():
        open_viewer(runs)
    assert seen["cursors"] == [11, 16]
    assert "Verdict" in seen["views"]


@pytest.mark.parametrize(
    ("episodes", "episode", "view"), [(2, "reach-2", "Verdict"), (2, "metri", "loss"), (0, "Metrics", "loss")]
)
def test_a_tab_is_brought_to_the_front(tmp_path, seen, episodes, episode, view):
    write(tmp_path / "a.rrd", episodes=episodes)
    with needing_a_driver():
        open_viewer(tmp_path / "a.rrd", episode=episode, step=0)
    assert view in seen["views"]
    assert seen["cursors"] == [0]


def test_the_rest_of_a_cut_recording_is_shown(tmp_path, seen):
    content = write(tmp_path / "a.rrd", steps=400).read_bytes()
    (tmp_path / "a.rrd").write_bytes(content[: int(0.9 * len(content))])
    with needing_a_driver(), pytest.warns(UserWarning, match="was not closed"):
        open_viewer(tmp_path / "a.rrd")
    assert "Verdict" in seen["views"]


def test_episodes_side_by_side_come_before_their_own_tabs(tmp_path):
    rollout = TensorDict({"observation": torch.rand(9, 39), "action": torch.rand(9, 4)}, [9])
    with RerunLogger(tmp_path / "a.rrd") as logger:
        names = [logger.log_episode(rollout, task="reach", objects={}) for _ in range(2)]
        logger.compare(names)
        with pytest.raises(ValueError, match="names must be of two episodes or more"):
            logger.compare(["reach"])
        with pytest.raises(ValueError, match="names must be one of 'reach', 'reach-2', got 'push'"):
            logger.compare(["reach", "push"])
    recording = Recording(tmp_path / "a.rrd")
    assert recording.tabs() == ["Side by side", "reach", "reach-2"]
    assert recording.shown_tabs()["Side by side"] == ["reach", "reach-2"]


def test_a_complete_recording_is_read_in_place(tmp_path):
    with readable(write(tmp_path / "a.rrd")) as file:
        assert file == tmp_path / "a.rrd"
