"""Figures of query evaluators: how reliable their probabilities are, and an ImageQueryEvaluator's wrong answers."""

from __future__ import annotations

from dataclasses import dataclass
from textwrap import fill
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from lw_torchrl._checks import checked
from lw_torchrl._files import AnyPath
from lw_torchrl.evaluation.evaluator_report import BINS, PARTS, EvaluatorReport, clause_logits
from lw_torchrl.evaluation.figures import check_image, new_figure, saved, trim
from lw_torchrl.language.queries import Clause
from lw_torchrl.modules.image_query_evaluator import ImageQueryEvaluator
from lw_torchrl.modules.networks import evaluating
from lw_torchrl.training.labelled_queries import LabelledQueries

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@checked
def plot_reliability(report: EvaluatorReport, path: AnyPath | None = None) -> Figure:
    """Draw, for each part of a report, the share of answers that are true over their mean probability, and how many
    answers there are.

    Args:
        report: of :func:`score_evaluator`.
        path: as for :func:`plot_success`.

    Example:
        >>> import torch
        >>> from lw_torchrl.evaluation.evaluator_report import PartScore
        >>> score = PartScore({"near": (9, 1)}, {"near": (9, 1)}, torch.ones(15, 3, dtype=torch.float64))
        >>> len(plot_reliability(EvaluatorReport({"states": score}, {})).axes)
        2
    """
    check_image(path)
    figure = new_figure(4.2 * len(report.parts), 5.0)
    both = figure.subplots(2, len(report.parts), squeeze=False, sharex=True, height_ratios=(3, 1))
    for (part, score), upper, lower in zip(report.parts.items(), *both, strict=True):
        number, told, true = score.reliability.numpy().T
        there = number > 0
        upper.plot([0, 1], [0, 1], color="#bab0ac", linewidth=1)
        upper.plot(told[there] / number[there], true[there] / number[there], "o-", color="#4c78a8", markersize=4)
        numbers = f"accuracy {score.accuracy():.4f}, calibration error {score.calibration_error:.4f}"
        upper.set_title(f"{PARTS[part]}\n{numbers}", fontsize=9)
        upper.set_ylabel("share that holds")
        lower.bar([(place + 0.5) / BINS for place in range(BINS)], number, width=0.9 / BINS, color="#4c78a8")
        lower.set_yscale("log")
        lower.set_ylabel("answers")
        lower.set_xlabel("probability that it holds")
        for axes in (upper, lower):
            trim(axes)
    return saved(figure, path)


@dataclass(frozen=True)
class WrongAnswer:
    """A state in which a clause was answered wrongly: whether it holds, the probability that was believed, the
    ``pixels`` (H, W·C, 3) uint8 that were seen, and for the subject and the object, where they are told by name, how
    far ``off`` they were taken to be, metres."""

    clause: Clause
    holds: bool
    believed: float
    pixels: Tensor
    off: dict[str, float]


@checked
def wrong_answers(evaluator: ImageQueryEvaluator, data: LabelledQueries, most: int = 12) -> list[WrongAnswer]:
    """The surest wrong answers in held-out states, at most one of each clause and ``most`` in all.

    Args:
        evaluator, data: of pictures.
    """
    found = []
    with torch.no_grad(), evaluating(evaluator):
        for asked in data.parts["states"]:
            logits, truth = clause_logits(evaluator, asked)[0]
            believed = logits.sigmoid()
            surest = (believed - truth.float()).abs().argmax(0).tolist()  # of each clause
            for column, (row, clause) in enumerate(zip(surest, asked.clauses, strict=True)):
                told, holds = float(believed[row, column]), bool(truth[row, column])
                if (told > 0.5) == holds:
                    continue
                pixels, off = asked.seen("pixels")[row], {}
                if evaluator.names:
                    places, _ = evaluator.network.places(pixels[None], evaluator.network.names.weight)
                    true = asked.task.positions(asked.observation[row])
                    for name in filter(None, (clause.subject, clause.object)):
                        off[name] = float((places[0, evaluator.names.index(name), :3] - true[name]).norm())
                found.append(WrongAnswer(clause, holds, told, pixels, off))
    return sorted(found, key=lambda one: -abs(one.believed - one.holds))[:most]


@checked
def plot_wrong_answers(
    evaluator: ImageQueryEvaluator, data: LabelledQueries, path: AnyPath | None = None, most: int = 12
) -> Figure:
    """Draw the surest wrong answers in held-out states: the pictures, what was asked, and how far from where they are
    the things were taken to be.

    Args:
        evaluator, data, most: as for :func:`wrong_answers`; data that hold out no state raise :class:`ValueError`.
        path: as for :func:`plot_success`.
    """
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    check_image(path)
    if not data.parts["states"]:
        raise ValueError("data must hold out states, for an evaluator to be asked")
    found = wrong_answers(evaluator, data, most)
    columns = min(3, max(1, len(found)))
    rows = max(1, -(-len(found) // columns))
    figure = new_figure(3.9 * columns, 2.7 * rows)
    figure.set_layout_engine(ConstrainedLayoutEngine(h_pad=0.12))
    panels = figure.subplots(rows, columns, squeeze=False).reshape(-1)
    for axes in panels:
        axes.axis("off")
    for axes, one in zip(panels, found, strict=False):
        axes.imshow(one.pixels.numpy())
        said = f"{one.clause}: {'holds' if one.holds else 'does not hold'}, believed with {one.believed:.2f}"
        axes.set_title(fill(said, 44), fontsize=8)
        off = ", ".join(f"{name} {100 * far:.1f} cm off" for name, far in one.off.items())
        axes.text(0.5, -0.03, off, transform=axes.transAxes, ha="center", va="top", fontsize=8, color="#b04a3a")
    if not found:
        panels[0].text(0.5, 0.5, "no answer was wrong", ha="center")
    return saved(figure, path)
