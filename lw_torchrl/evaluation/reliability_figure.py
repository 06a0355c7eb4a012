"""The reliability picture: how often what an evaluator holds for so probable is true."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from lw_torchrl._checks import checked
from lw_torchrl.evaluation.evaluator_report import BINS, PARTS, EvaluatorReport
from lw_torchrl.evaluation.figures import check_image, saved

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@checked
def plot_reliability(report: EvaluatorReport, path: str | os.PathLike[str] | None = None) -> Figure:
    """Draw, for each part of a report, the share of answers that are true over their mean probability, and how many
    answers there are.

    Args:
        report: of :func:`score_evaluator`.
        path: an image file, .png, .svg, .pdf or .jpg; it is replaced whole. None for none.

    Returns:
        The figure.

    Raises:
        ValueError: another format.

    Example:
        >>> import torch
        >>> from lw_torchrl.evaluation.evaluator_report import PartScore
        >>> score = PartScore({"near": (9, 1)}, {"near": (9, 1)}, torch.ones(15, 3, dtype=torch.float64))
        >>> len(plot_reliability(EvaluatorReport({"states": score}, {})).axes)
        2
    """
    from matplotlib.figure import Figure

    check_image(path)
    figure = Figure(figsize=(4.2 * len(report.parts), 5.0), layout="constrained")
    both = figure.subplots(2, len(report.parts), squeeze=False, sharex=True, height_ratios=(3, 1))
    for (part, score), upper, lower in zip(report.parts.items(), *both, strict=True):
        number, told, true = score.reliability.numpy().T
        there = number > 0
        upper.plot([0, 1], [0, 1], color="#bab0ac", linewidth=1)
        upper.plot(told[there] / number[there], true[there] / number[there], "o-", color="#4c78a8", markersize=4)
        upper.set_title(
            f"{PARTS[part]}\naccuracy {score.accuracy():.4f}, calibration error {score.calibration_error:.4f}",
            fontsize=9,
        )
        upper.set_ylabel("share that holds")
        lower.bar([(place + 0.5) / BINS for place in range(BINS)], number, width=0.9 / BINS, color="#4c78a8")
        lower.set_yscale("log")
        lower.set_ylabel("answers")
        lower.set_xlabel("probability that it holds")
        for axes in (upper, lower):
            axes.spines[["top", "right"]].set_visible(False)
    return saved(figure, path)
