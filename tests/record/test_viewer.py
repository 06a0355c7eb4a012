"""The viewer: opened at a tab, made to draw, and shown what is left of a recording that was cut."""

from __future__ import annotations

import os
import socket
import stat
import time
from contextlib import contextmanager
from types import SimpleNamespace

import pytest
import rerun
import torch
from recordings import Recording
from rerun.chunk import RrdReader
from tensordict import TensorDict

from lw_torchrl.record import RerunLogger, open_viewer, viewer
from lw_torchrl.record.recording_file import find_recording, is_whole, opened, opening_step, running
from lw_torchrl.record.viewer import connect, go_to


def write(path, steps=20):
    """A recording of an episode."""
    rollout = TensorDict({"observation": torch.rand(steps, 39), "action": torch.rand(steps, 4)}, [steps])
    rollout["next", "success"] = torch.arange(steps)[:, None] >= steps // 2
    with RerunLogger(path) as logger:
        logger.log_episode(rollout, task="reach", objects={"puck": rollout["observation"][:, 4:7]})


def fake_viewer(tmp_path, monkeypatch, prints, code):
    script = tmp_path / "viewer"
    script.write_text(f"#!/bin/sh\n[ \"$1\" = rrd ] && exit 0\necho '{prints}'\nexit {code}\n")
    script.chmod(script.stat().st_mode | stat.S_IEXEC)
    monkeypatch.setenv("RERUN_CLI_PATH", str(script))


@pytest.mark.parametrize(
    ("prints", "message"),
    [
        (
            "thread main panicked at Failed to get render context",
            "apt-get install libvulkan1 mesa-vulkan-drivers",
        ),
        ("Error: neither WAYLAND_DISPLAY nor DISPLAY is set.", "there is no screen here"),
        ("No glyph for X in Proportional.", "outside the one font"),
        ("something else", "ended with an error:\nsomething else"),
    ],
)
@pytest.mark.parametrize("screenshot", [None, "a.png"])
def test_a_failing_viewer_says_what_to_do(tmp_path, monkeypatch, prints, message, screenshot):
    RerunLogger(tmp_path / "a.rrd").shutdown()
    fake_viewer(tmp_path, monkeypatch, prints, 102)
    with pytest.raises(RuntimeError, match=message):
        open_viewer(tmp_path / "a.rrd", None if screenshot is None else tmp_path / screenshot)
    assert sorted(os.listdir(tmp_path)) == ["a.rrd", "viewer"]


def test_the_viewer_is_started_with_the_file(tmp_path, monkeypatch):
    RerunLogger(tmp_path / "a.rrd").shutdown()
    fake_viewer(tmp_path, monkeypatch, f"' \"$1\" > {tmp_path}/seen; echo '", 0)
    open_viewer(tmp_path / "a.rrd")
    assert (tmp_path / "seen").read_text().strip() == str(tmp_path / "a.rrd")


def test_wrong_arguments_of_the_viewer(tmp_path):
    RerunLogger(tmp_path / "a.rrd").shutdown()
    (tmp_path / "b.rrd").write_text("no recording")
    with pytest.raises(FileNotFoundError, match="does not exist"):
        open_viewer(tmp_path / "c.rrd")
    with pytest.raises(FileNotFoundError, match=r"must hold one recording \(\*\.rrd\), got a\.rrd, b\.rrd"):
        open_viewer(tmp_path)
    with pytest.raises(ValueError, match="is no rerun recording: it begins with b'no r'"):
        open_viewer(tmp_path / "b.rrd")
    with pytest.raises(ValueError, match="window_size must be like"):
        open_viewer(tmp_path / "a.rrd", window_size="big")
    with pytest.raises(ValueError, match=r"screenshot must end in '\.png'"):
        open_viewer(tmp_path / "a.rrd", tmp_path / "a.jpg")
    with pytest.raises(ValueError, match="step 3 was given, but the recording holds no steps"):
        open_viewer(tmp_path / "a.rrd", step=3)


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
    with pytest.raises(ValueError, match="step must be at most 21"):
        open_viewer(tmp_path / "a.rrd", tmp_path / "b.png", step=22)
    assert sorted(os.listdir(tmp_path)) == ["a.png", "a.rrd"]


def entities_of_copy(path):
    """What a viewer would open of a recording that was not closed."""
    with opened(path) as copy:
        assert is_whole(copy)
        return Recording(copy).entities()


def test_a_viewer_that_says_nothing_is_not_waited_for_for_ever(monkeypatch):
    monkeypatch.setattr("lw_torchrl.record.viewer.START_SECONDS", 1.0)
    with socket.create_server(("127.0.0.1", 0)) as mute:  # it takes connections, and that is all
        began = time.monotonic()
        with pytest.raises(TimeoutError, match="no answer within 1 seconds"):
            connect(SimpleNamespace(poll=lambda: None), mute.getsockname()[1])
        assert time.monotonic() - began < 10


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9, 0.99])
def test_what_is_left_of_a_cut_recording_is_shown(tmp_path, share):
    write(tmp_path / "a.rrd", steps=400)
    content = (tmp_path / "a.rrd").read_bytes()
    (tmp_path / "cut.rrd").write_bytes(content[: int(share * len(content))])
    whole = Recording(tmp_path / "a.rrd").entities()
    with pytest.warns(UserWarning, match=r"cut\.rrd' was not closed"):
        found = entities_of_copy(tmp_path / "cut.rrd")
    assert found <= whole
    assert len(found) > 1
    assert "/reach/action" in found or share < 0.9


def test_a_recording_of_which_nothing_is_left(tmp_path):
    write(tmp_path / "a.rrd")
    (tmp_path / "cut.rrd").write_bytes((tmp_path / "a.rrd").read_bytes()[:50])
    for picture in (None, tmp_path / "a.png"):
        with (
            pytest.warns(UserWarning, match="was not closed"),
            pytest.raises(ValueError, match=r"cut\.rrd' is damaged: "),
        ):
            open_viewer(tmp_path / "cut.rrd", picture)
    assert sorted(os.listdir(tmp_path)) == ["a.rrd", "cut.rrd"]


def test_a_damaged_recording_is_refused(tmp_path):
    write(tmp_path / "a.rrd")
    content = bytearray((tmp_path / "a.rrd").read_bytes())
    content[len(content) // 2 : len(content) // 2 + 2000] = bytes(2000)
    (tmp_path / "a.rrd").write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.rrd' is damaged: "):
        open_viewer(tmp_path / "a.rrd")


def test_a_folder_stands_for_its_recording(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"must hold one recording .*, got none"):
        find_recording(tmp_path)
    for _ in range(2):
        write(tmp_path / "a.rrd")
    assert sorted(os.listdir(tmp_path)) == ["a.previous.rrd", "a.rrd"]
    assert find_recording(tmp_path) == tmp_path / "a.rrd"


@pytest.mark.parametrize(
    ("name", "title", "timeline"),
    [
        ("reach", "reach", "step"),
        ("Metrics", "Metrics", "global_step"),
        ("metri", "Metrics", "global_step"),
        ("2", "reach-2", "step"),
    ],
)
def test_a_tab_is_brought_to_the_front(tmp_path, name, title, timeline):
    rollout = TensorDict({"observation": torch.rand(5, 39), "action": torch.rand(5, 4)}, [5])
    with RerunLogger(tmp_path / "a.rrd") as logger:
        for _ in range(2):
            logger.log_episode(rollout, task="reach", objects={})
        logger.log_scalar("loss/bc", 1.0)
    with opened(tmp_path / "a.rrd", name) as copy:
        assert Recording(copy).entities() == Recording(tmp_path / "a.rrd").entities()
        assert Recording(copy).front() == (title, timeline)
    with (
        pytest.raises(ValueError, match="episode must be one of 'overview', 'Metrics', 'reach', 'reach-2', got 'rea'"),
        opened(tmp_path / "a.rrd", "rea"),
    ):
        pass


def test_a_picture_of_an_episode_is_of_the_step_that_tells_most(tmp_path):
    rollout = TensorDict({"observation": torch.rand(9, 39), "action": torch.rand(9, 4)}, [9])
    won = rollout.clone().set(("next", "success"), torch.arange(9).unsqueeze(-1) >= 3)
    with RerunLogger(tmp_path / "a.rrd") as logger:
        names = [logger.log_episode(one, task="reach", objects={}) for one in (won, rollout)]
        logger.log_scalar("loss/bc", 1.0)
    found = [opening_step(tmp_path / "a.rrd", tab) for tab in (None, *names, "Metrics")]
    assert found == [4, 4, 9, None]
    assert opening_step(tmp_path / "a.rrd", names[1], 7) == 7
    with pytest.raises(ValueError, match="step must be at most 0, the recording's last, got 1"):
        opening_step(tmp_path / "a.rrd", "Metrics", 1)


@pytest.mark.parametrize("timeline", ["step", "global_step"])
def test_a_recording_that_does_not_say_its_tabs_opens_at_a_step_too(tmp_path, timeline):
    """Those of earlier versions do not."""
    stream = rerun.RecordingStream("lw_torchrl")
    stream.save(tmp_path / "a.rrd")
    for step in range(4):
        stream.set_time(timeline, sequence=step)
        stream.log("curve", rerun.Scalars(step))
    stream.disconnect()
    assert opening_step(tmp_path / "a.rrd") is None
    assert opening_step(tmp_path / "a.rrd", step=2) == 2
    with pytest.raises(ValueError, match="step must be at most 3"):
        opening_step(tmp_path / "a.rrd", step=4)


def test_a_window_opens_at_the_step_that_tells_most(tmp_path, monkeypatch):
    """The window is one without a screen, which is asked where it stands."""
    write(tmp_path / "a.rrd")
    stood = []

    @contextmanager
    def headless(*arguments):
        with running(*arguments, "--headless") as (process, output):
            yield SimpleNamespace(poll=process.poll, wait=process.poll), output

    def go_and_close(client, recording, step):
        go_to(client, recording, step)
        stood.append(client.get_state().recordings[0].current_time)

    monkeypatch.setattr(viewer, "running", headless)
    monkeypatch.setattr(viewer, "go_to", go_and_close)
    with needing_a_driver():
        open_viewer(tmp_path / "a.rrd")
    assert stood == [11]


def test_episodes_are_compared_before_their_own_tabs(tmp_path):
    rollout = TensorDict({"observation": torch.rand(9, 39), "action": torch.rand(9, 4)}, [9])
    with RerunLogger(tmp_path / "a.rrd") as logger:
        names = [logger.log_episode(rollout, task="reach", objects={}) for _ in range(2)]
        logger.compare(names)
        with pytest.raises(ValueError, match="names must be of two episodes or more, got reach"):
            logger.compare(["reach"])
        with pytest.raises(ValueError, match="names must be one of 'reach', 'reach-2', got 'push'"):
            logger.compare(["reach", "push"])
    recording = Recording(tmp_path / "a.rrd")
    assert recording.tabs() == ["Side by side", "reach", "reach-2"]
    assert recording.shown_tabs()["Side by side"] == ["reach", "reach-2"]


def test_two_recordings_in_one_viewer_keep_a_layout_each(tmp_path):
    for name in ("a", "b"):
        write(tmp_path / f"{name}.rrd")
    a, b = (RrdReader(tmp_path / f"{name}.rrd").recordings()[0].application_id for name in ("a", "b"))
    assert a.startswith("a-")
    assert a[2:] != b[2:]
