"""Progress: a bar on a terminal, else a line of text every 30 seconds, and nothing before a second has passed."""

import io
import sys

import pytest

from lw_torchrl._util import progress as _progress
from lw_torchrl._util.progress import Progress


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def clock(monkeypatch):
    """Return a function that advances the time of progress reports."""
    now = [100.0]
    monkeypatch.setattr(_progress.time, "monotonic", lambda: now[0])
    return lambda seconds: now.__setitem__(0, now[0] + seconds)


def test_without_a_terminal_a_line_appears_every_30_seconds(capsys, clock):
    with Progress("training", 8000, "step", initial=500) as progress:
        progress.note(loss="0.012")
        for _ in range(3000):
            clock(0.1)
            progress.update()
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) in (9, 10)
    assert lines[-1] == f"training: {lines[-1].split()[1]} steps, 8 min left, loss 0.012"
    assert abs(int(lines[4].split()[1].split("/")[0]) - 2000) <= 5


def test_repeated_work_and_work_that_has_not_begun(capsys, clock):
    with Progress("collecting", 1000, "step", initial=400) as progress:
        clock(31)
        progress.update(0)
        progress.update(200)
        clock(31)
        progress.update(-100)
    shown = capsys.readouterr().err
    assert shown == "collecting: 400/1000 steps\ncollecting: 500/1000 steps, 5 min left\n"


@pytest.mark.parametrize("stream", [Terminal(), io.StringIO()])
def test_short_work_shows_nothing(monkeypatch, stream):
    monkeypatch.setattr(sys, "stderr", stream)
    with Progress("evaluating", 10, "step") as progress:
        progress.update(10)
    assert stream.getvalue() == ""


def test_terminal_shows_a_bar(monkeypatch):
    monkeypatch.setattr(sys, "stderr", stream := Terminal())
    monkeypatch.setattr(_progress, "DELAY", 0.0)
    with Progress("training", 4, "step", initial=1) as progress:
        progress.note(loss="0.5")
        for units in (3, -2, 1):
            progress.update(units)
    assert all(text in stream.getvalue() for text in ("training", "loss=0.5", "3/4"))


@pytest.mark.parametrize("stream", [None, "a terminal"])
def test_nothing_is_shown_if_switched_off_or_without_stderr(monkeypatch, clock, stream):
    monkeypatch.setattr(sys, "stderr", shown := None if stream is None else Terminal())
    with Progress("training", 4, "step", show=stream is None) as progress:
        clock(100)
        progress.update()
    assert progress.done == 1
    assert shown is None or shown.getvalue() == ""
