"""python -m benchmarks.docs_figures: draw the figures of README and docs from the numbers printed there."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import tyro

from benchmarks.figures import METHOD_COLORS, NEUTRAL_STYLE, draw_rates, plot_panels
from lw_torchrl.evaluation.figures import new_figure
from lw_torchrl.evaluation.result import wilson_interval

NUMBERS = Path(__file__).parent / "data" / "published_results.json"


@dataclass(frozen=True)
class Arguments:
    """Draw the figures of README and docs, with 95 % intervals and colors for light and dark mode."""

    out: Path = Path("docs")
    """Folder for the pictures."""


WIDTH = 7.2
"""Size of a figure in inches of 100 pixels. With 13-point text, a figure is legible at half this width."""


def experiments(numbers: Any) -> Any:
    """Draw success on all 50 tasks in the paper's three settings."""
    figure = new_figure(WIDTH, 3.6)
    panels = figure.subplots(1, 3, sharey=True)
    names, methods, *settings = zip(*numbers["rows"], strict=True)
    for axes, title, rates in zip(panels, numbers["panels"], settings, strict=True):
        draw_rates(axes, names, rates, [METHOD_COLORS[method] for method in methods])
        axes.set_title(title)
    figure.supxlabel("success over 50 tasks; lines: 95 % intervals", fontsize=13)
    return figure


def zero_shot(numbers: Any) -> Any:
    """Draw success on the test tasks, which have no demonstrations, with plans, generic plans and descriptions."""
    figure = new_figure(WIDTH, 5.4)
    axes = figure.subplots()
    names, methods, rates = zip(*numbers["rows"], strict=True)
    draw_rates(axes, names, rates, [METHOD_COLORS[method] for method in methods])
    figure.suptitle("Success on 20 tasks that nobody demonstrated", fontsize=16, fontweight="bold")
    caption = "policies trained on 10 other tasks; lines: 95 % intervals over tasks and seeds"
    figure.supxlabel(caption, fontsize=13)
    return figure


def demonstrations(numbers: Any) -> Any:
    """Draw success by the number of demonstrations of each demonstrated task."""
    places = [str(number) for number in numbers["numbers"]]
    panels = [
        (title, places, {name: [[rate] for rate in rates] for name, rates in methods.items()})
        for title, methods in numbers["panels"]
    ]
    return plot_panels(panels, xlabel="demonstrations of each demonstrated task")


def truth(numbers: Any) -> Any:
    """Draw success with late and with wrong answers to conditions."""
    return plot_panels(numbers["panels"])


def offline(numbers: Any) -> Any:
    """Draw success of offline-RL methods on three mixtures of noisy data."""
    figure = new_figure(WIDTH, 4.4)
    panels = figure.subplots(1, 3, sharey=True)
    names = [row[0] for row in numbers["rows"]]
    colors = [METHOD_COLORS["plan"] if name == "advantage" else METHOD_COLORS["baseline"] for name in names]
    for column, (axes, title) in enumerate(zip(panels, numbers["panels"], strict=True), 1):
        draw_rates(axes, names, [row[column] for row in numbers["rows"]], colors)
        axes.set_title(title, fontsize=13)
    figure.supxlabel("success; lines: 95 % intervals over three seeds", fontsize=13)
    return figure


def scripted(numbers: Any) -> Any:
    """Draw success of plans with scripted skills, without training, on the tasks with at least one failure."""
    figure = new_figure(WIDTH, 4.4)
    axes = figure.subplots()
    episodes, successes = numbers["episodes"], numbers["successes"]
    rates = [[hits / episodes, *wilson_interval(hits, episodes)] for hits in successes.values()]
    draw_rates(axes, [*successes], rates, [METHOD_COLORS["scripted skills"]] * len(rates))
    figure.suptitle("Plans with scripted skills, without training", fontsize=16, fontweight="bold")
    figure.supxlabel(f"success in {episodes} episodes of each of 50 tasks; lines: 95 % intervals", fontsize=13)
    return figure


FIGURES = {
    "experiments.png": ("experiments", experiments),
    "zero-shot-plans.png": ("zero_shot_test_tasks", zero_shot),
    "demonstrations.png": ("demonstrations", demonstrations),
    "truth.png": ("truth", truth),
    "offline.png": ("offline", offline),
    "scripted.png": ("scripted", scripted),
}
"""The figures by file name: the file with the numbers, and the function that draws them."""


def main(arguments: Arguments) -> None:
    numbers = json.loads(NUMBERS.read_text("utf-8"))
    with matplotlib.rc_context(NEUTRAL_STYLE):
        for name, (key, draw) in FIGURES.items():
            draw(numbers[key]).savefig(arguments.out / name, dpi=100)
            print(f"written to {arguments.out / name}")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
