"""The figure of the success rates, and its intervals."""

from __future__ import annotations

import struct
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lw_torchrl.evaluation import (
    EpisodeResult,
    EvaluationResult,
    plot_sorted_tasks,
    plot_success,
    summarize_rates,
)
from lw_torchrl.evaluation.statistics import wilson_interval
from lw_torchrl.language.tasks import MT50


def make_result(rates, trials=4):
    episodes = [
        EpisodeResult(task, k, k < hits, 5 if k < hits else None, k < hits, float(k < hits))
        for task, hits in rates.items()
        for k in range(trials)
    ]
    config = {"tasks": list(rates), "episodes_per_task": trials, "seed": 0, "noise_scale": 0.1}
    return EvaluationResult(config, tuple(episodes))


RATES = {task: number / 50 for number, task in enumerate(MT50)}
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


@given(st.integers(1, 200), st.data())
def test_more_trials_of_the_same_rate_narrow_it(trials, data):
    successes = data.draw(st.integers(0, trials))
    low, high = wilson_interval(successes, trials)
    narrow = wilson_interval(10 * successes, 10 * trials)
    assert narrow[1] - narrow[0] < high - low


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
    assert [found.name for found in path.parent.iterdir()] == ["success.png"]


@pytest.mark.parametrize(("suffix", "start"), [("svg", b"<?xml"), ("pdf", b"%PDF")])
def test_the_suffix_chooses_the_format(tmp_path, suffix, start):
    plot_success(RESULT, tmp_path / f"success.{suffix}")
    assert (tmp_path / f"success.{suffix}").read_bytes().startswith(start)


def test_the_bars_are_the_rates_best_on_top(tmp_path):
    axes = plot_success(RESULT, tmp_path / "success.png").axes[0]
    assert [bar.get_width() for bar in axes.patches] == [0.0, 0.25, 1.0]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["sweep", "push", "reach"]
    assert f"{RESULT.mean_success:.3f}" in axes.get_title()
    assert "4" in axes.get_xlabel()


def test_fifty_tasks_and_one_fit(tmp_path):
    for tasks in (50, 1):
        figure = plot_success(make_result({f"task {i}": i % 5 for i in range(tasks)}), tmp_path / f"{tasks}.png")
        assert len(figure.axes[0].patches) == tasks


def test_a_failure_leaves_the_old_figure(tmp_path, monkeypatch):
    path = tmp_path / "success.png"
    plot_success(RESULT, path)
    before = path.read_bytes()

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", full)
    with pytest.raises(OSError, match="No space"):
        plot_success(RESULT, path)
    assert path.read_bytes() == before
    assert [found.name for found in tmp_path.iterdir()] == ["success.png"]


def test_it_opens_no_window_and_chooses_no_backend(tmp_path):
    import sys

    pyplot = sys.modules.pop("matplotlib.pyplot", None)
    plot_success(RESULT, tmp_path / "success.png")
    assert "matplotlib.pyplot" not in sys.modules
    if pyplot is not None:
        sys.modules["matplotlib.pyplot"] = pyplot


PCBC = {"push": [0.5, 0.75], "reach": [1.0, 0.9], "sweep": [0.0, 0.33]}
DC = {"push": [0.25], "reach": [0.5], "sweep": [0.75]}


def lines(figure):
    """Label to the heights of the curves in the legend."""
    return {line.get_label(): list(line.get_ydata()) for line in figure.axes[0].lines if line.get_label()[0] != "_"}


def levels(figure):
    """The lines across."""
    return [float(line.get_ydata()[0]) for line in figure.axes[0].lines if line.get_label()[0] == "_"]


def test_tasks_are_sorted_by_the_first_method(tmp_path):
    figure = plot_sorted_tasks({"PCBC": PCBC, "DC": DC}, tmp_path / "figure.png", title="few-shot")
    axes = figure.axes[0]
    assert [label.get_text() for label in axes.get_xticklabels()] == ["sweep", "push", "reach"]
    assert {label.get_rotation() for label in axes.get_xticklabels()} == {90}
    found = lines(figure)
    assert found["PCBC: mean 0.58 (2 seeds, min–max shaded)"] == pytest.approx([0.165, 0.625, 0.95])
    assert found["DC: mean 0.50 (1 seed)"] == pytest.approx([0.75, 0.25, 0.5])
    assert levels(figure) == pytest.approx([3.48 / 6, 0.5])
    assert axes.get_title() == "few-shot"
    assert [item.name for item in tmp_path.iterdir()] == ["figure.png"]


def test_the_band_spans_the_seeds(tmp_path):
    axes = plot_sorted_tasks({"PCBC": PCBC}, tmp_path / "figure.png").axes[0]
    corners = {tuple(corner) for corner in axes.collections[0].get_paths()[0].vertices.round(6).tolist()}
    assert {(0.0, 0.0), (0.0, 0.33), (1.0, 0.5), (1.0, 0.75), (2.0, 0.9), (2.0, 1.0)} <= corners


def test_each_curve_can_be_sorted_for_itself(tmp_path):
    figure = plot_sorted_tasks({"PCBC": PCBC, "DC": DC}, tmp_path / "figure.png", order="own")
    assert all(heights == sorted(heights) for heights in lines(figure).values())
    assert [label.get_text() for label in figure.axes[0].get_xticklabels()] == ["1", "2", "3"]


def test_published_curves_are_dashed_and_say_what_they_are(tmp_path):
    ours = {task: [rate, 1.0] for task, rate in RATES.items()}
    curves = {"best": dict.fromkeys(RATES, 0.63), "last": RATES}
    figure = plot_sorted_tasks({"PCBC": ours}, tmp_path / "figure.png", published=curves)
    labels = ["best: mean 0.63", "last: mean 0.49"]
    tasks = [label.get_text() for label in figure.axes[0].get_xticklabels()]
    assert lines(figure)[labels[1]] == [RATES[task] for task in tasks]
    for line in figure.axes[0].lines:
        assert line.is_dashed() == (line.get_label() in labels) or line.get_label()[0] == "_"
    shown = [text.get_text() for text in figure.legends[0].get_texts()]
    assert [label for label in shown if label.strip()] == [next(iter(lines(figure))), *labels]
    assert len(tasks) == 50


@pytest.mark.parametrize("tasks", [50, 34, 10, 2])
def test_neither_labels_nor_legend_are_cut_or_overlap(tmp_path, tasks):
    ours = {task: [rate, 1.0] for task, rate in [*RATES.items()][:tasks]}
    figure = plot_sorted_tasks(
        {name: ours for name in ("PCBC", "DC", "one-hot")},
        tmp_path / "figure.png",
        published={f"{name} published, {which}": RATES for name in ("PCBC", "DC") for which in ("best", "last")},
    )
    figure.draw_without_rendering()  # saving used another resolution
    width, height = figure.bbox.size
    ticks = [label.get_window_extent() for label in figure.axes[0].get_xticklabels()]
    legend = figure.legends[0].get_window_extent()
    assert all(left.x1 <= right.x0 for left, right in pairwise(ticks))
    for box in (*ticks, legend, figure.axes[0].xaxis.label.get_window_extent()):
        assert box.x0 >= 0
        assert box.y0 >= 0
        assert box.x1 <= width
        assert box.y1 <= height
    assert min(box.y0 for box in ticks) >= legend.y1


def test_a_summary_is_a_curve(tmp_path):
    from_rates = plot_sorted_tasks({"PCBC": PCBC}, tmp_path / "a.png")
    from_summary = plot_sorted_tasks({"PCBC": summarize_rates(PCBC)}, tmp_path / "b.png")
    assert lines(from_rates) == lines(from_summary)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


@pytest.mark.parametrize(
    ("curves", "options", "message"),
    [
        ({}, {}, "curves must hold at least one method, got none"),
        ({"PCBC": PCBC, "DC": {"push": [0.5]}}, {}, r"'PCBC' and 'DC' do not share \['reach', 'sweep'\]"),
        ({"PCBC": {"push": [0.5], "reach": [0.5, 0.5]}}, {}, r"curves\['PCBC'\] must hold a rate per seed"),
        ({"PCBC": {"push": [1.5]}}, {}, r"curves\['PCBC'\] must be rates in \[0, 1\], got 1.5"),
        ({"PCBC": {}}, {}, r"curves\['PCBC'\] must have shape"),
        ({"PCBC": PCBC}, {"published": {"last": {"push": 0.5}}}, r"published\['last'\] lacks the tasks"),
        ({"PCBC": PCBC}, {"order": "alphabet"}, "order must be one of 'shared', 'own', got 'alphabet'"),
    ],
)
def test_wrong_curves_are_refused_before_a_file_is_written(tmp_path, curves, options, message):
    with pytest.raises(ValueError, match=message):
        plot_sorted_tasks(curves, tmp_path / "figure.png", **options)
    assert not list(tmp_path.iterdir())


def test_without_a_path_the_figure_is_returned_and_nothing_is_written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for draw, shown in ((plot_success, RESULT), (plot_sorted_tasks, {"PCBC": PCBC})):
        saved = draw(shown, "figure.png")
        Path("figure.png").unlink()
        figure = draw(shown)
        assert figure.axes[0].get_xlabel() == saved.axes[0].get_xlabel() != ""
        assert list(tmp_path.iterdir()) == []
        figure.savefig("mine.png")
        Path("mine.png").unlink()


@pytest.mark.parametrize("name", ["figure.xyz", "figure", "figure.txt"])
def test_a_format_that_is_none_is_named(tmp_path, name):
    message = rf"path must end in .png, .svg, .pdf, .jpg, .jpeg, got '{Path(name).suffix}'"
    with pytest.raises(ValueError, match=message):
        plot_sorted_tasks({"PCBC": {"reach": [1.0]}}, tmp_path / name)
    with pytest.raises(ValueError, match=message):
        plot_success(make_result({"reach": 1.0}), tmp_path / name)
    assert not any(tmp_path.iterdir())
