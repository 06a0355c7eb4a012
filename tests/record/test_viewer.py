"""The viewer: opened, made to draw, and a recording refused before it waits for what does not come."""

from __future__ import annotations

import os
import stat
import time

import pytest
import torch
from tensordict import TensorDict

from lw_torchrl.record import RerunLogger, open_viewer


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
    with pytest.raises(FileNotFoundError, match="is a folder"):
        open_viewer(tmp_path)
    with pytest.raises(ValueError, match="is no rerun recording: it begins with b'no r'"):
        open_viewer(tmp_path / "b.rrd")
    with pytest.raises(ValueError, match="window_size must be like"):
        open_viewer(tmp_path / "a.rrd", window_size="big")
    with pytest.raises(ValueError, match=r"screenshot must end in '\.png'"):
        open_viewer(tmp_path / "a.rrd", tmp_path / "a.jpg")
    with pytest.raises(ValueError, match="give screenshot as well"):
        open_viewer(tmp_path / "a.rrd", step=3)


def test_a_picture_is_taken_where_the_machine_can_draw(tmp_path):
    write(tmp_path / "a.rrd")
    try:
        open_viewer(tmp_path / "a.rrd", tmp_path / "a.png", "800x600", step=10)
    except RuntimeError as error:
        if "no graphics driver" in str(error):
            pytest.skip("no graphics driver")
        raise
    assert (tmp_path / "a.png").read_bytes()[16:24] == (800).to_bytes(4, "big") + (600).to_bytes(4, "big")
    with pytest.raises(ValueError, match="step must be at most 21"):
        open_viewer(tmp_path / "a.rrd", tmp_path / "b.png", step=22)
    assert sorted(os.listdir(tmp_path)) == ["a.png", "a.rrd"]


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.99])
@pytest.mark.parametrize("picture", [False, True])
def test_a_cut_recording_is_refused_at_once(tmp_path, share, picture):
    write(tmp_path / "a.rrd")
    content = (tmp_path / "a.rrd").read_bytes()
    (tmp_path / "cut.rrd").write_bytes(content[: int(share * len(content))])
    started = time.monotonic()
    with pytest.raises(ValueError, match=r"cut\.rrd' is cut or damaged: "):
        open_viewer(tmp_path / "cut.rrd", tmp_path / "a.png" if picture else None)
    assert time.monotonic() - started < 30
    assert sorted(os.listdir(tmp_path)) == ["a.rrd", "cut.rrd"]
