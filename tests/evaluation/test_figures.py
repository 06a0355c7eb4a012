"""The figure of the success rates, and its intervals."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lw_torchrl.evaluation import (
    EpisodeResult,
    EvaluationResult,
    plot_success,
)
from lw_torchrl.evaluation.result import wilson_interval


def make_result(rates, trials=4):
    episodes = [
        EpisodeResult(task, k, k < hits, 5 if k < hits else None, k < hits, float(k < hits))
        for task, hits in rates.items()
        for k in range(trials)
    ]
    config = {"tasks": list(rates), "episodes_per_task": trials, "seed": 0, "noise_scale": 0.1}
    return EvaluationResult(config, tuple(episodes))


RESULT = make_result({"push": 1, "reach": 4, "sweep": 0})


@given(st.integers(1, 1000), st.data())
def test_the_interval_holds_the_rate_and_is_symmetric(trials, data):
    successes = data.draw(st.integers(0, trials))
    low, high = wilson_interval(successes, trials)
    assert 0 <= low <= successes / trials + 1e-12
    assert successes / trials - 1e-12 <= high <= 1
    assert high - low > 0
    mirrored = wilson_interval(trials - successes, trials)
    assert (1 - high, 1 - low) == pytest.approx(mirrored, abs=1e-9)


@pytest.mark.parametrize(
    ("successes", "trials", "expected"),
    [(8, 10, (0.4902, 0.9433)), (0, 20, (0.0, 0.1611)), (50, 100, (0.4038, 0.5962))],
)
def test_the_interval_by_the_textbook(successes, trials, expected):
    assert wilson_interval(successes, trials) == pytest.approx(expected, abs=2e-4)


def test_it_writes_a_whole_png(tmp_path):
    path = tmp_path / "runs" / "success.png"
    plot_success(RESULT, path, title="a title")
    content = path.read_bytes()
    assert content[:8] == b"\x89PNG\r\n\x1a\n"
    assert content[-8:-4] == b"IEND"
    width, height = struct.unpack(">II", content[16:24])
    assert width > 600
    assert height > 150
    plot_success(RESULT, tmp_path / "success.pdf")
    assert (tmp_path / "success.pdf").read_bytes().startswith(b"%PDF")


def test_the_bars_are_the_rates_best_on_top(tmp_path):
    axes = plot_success(RESULT, tmp_path / "success.png").axes[0]
    assert [bar.get_width() for bar in axes.patches] == [0.0, 0.25, 1.0]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["sweep", "push", "reach"]
    assert f"{RESULT.mean_success:.3f}" in axes.get_title()
    assert "4" in axes.get_xlabel()


def test_it_opens_no_window_and_chooses_no_backend(tmp_path):
    import sys

    pyplot = sys.modules.pop("matplotlib.pyplot", None)
    plot_success(RESULT, tmp_path / "success.png")
    assert "matplotlib.pyplot" not in sys.modules
    if pyplot is not None:
        sys.modules["matplotlib.pyplot"] = pyplot


def test_without_a_path_the_figure_is_returned_and_nothing_is_written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    saved = plot_success(RESULT, "figure.png")
    Path("figure.png").unlink()
    figure = plot_success(RESULT)
    assert figure.axes[0].get_xlabel() == saved.axes[0].get_xlabel() != ""
    assert list(tmp_path.iterdir()) == []
    figure.savefig("mine.png")


@pytest.mark.parametrize("name", ["figure.xyz", "figure", "figure.txt"])
def test_a_format_that_is_none_is_named(tmp_path, name):
    message = rf"path must end in .png, .svg, .pdf, .jpg, .jpeg, got '{Path(name).suffix}'"
    with pytest.raises(ValueError, match=message):
        plot_success(make_result({"reach": 1.0}), tmp_path / name)
    assert not any(tmp_path.iterdir())
