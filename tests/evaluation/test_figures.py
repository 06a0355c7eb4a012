"""The figure of success rates, and its confidence intervals."""

import struct
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lw_torchrl.evaluation import EpisodeResult, EvaluationResult, plot_success
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
def test_the_interval_contains_the_rate_and_is_symmetric(trials, data):
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
def test_the_interval_equals_published_values(successes, trials, expected):
    assert wilson_interval(successes, trials) == pytest.approx(expected, abs=2e-4)


def test_figures_are_written_as_png_and_pdf(tmp_path):
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


def test_the_bars_are_the_rates_best_on_top():
    axes = plot_success(RESULT).axes[0]
    assert [bar.get_width() for bar in axes.patches] == [0.0, 0.25, 1.0]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["sweep", "push", "reach"]
    assert f"{RESULT.mean_success:.3f}" in axes.get_title()
    assert "4" in axes.get_xlabel()


def test_no_window_is_opened_and_no_backend_chosen(monkeypatch):
    monkeypatch.delitem(sys.modules, "matplotlib.pyplot", raising=False)
    plot_success(RESULT)
    assert "matplotlib.pyplot" not in sys.modules
