"""Reports on learned query evaluators: calibration, confident errors, and the drift of answers during tuning."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill
from typing import Any

import torch
from matplotlib.layout_engine import ConstrainedLayoutEngine
from tensordict import TensorDictBase
from torch import Tensor

from lw_torchrl._util.files import write_json
from lw_torchrl.evaluation.evaluator_score import PARTS, clause_logits, score_evaluator
from lw_torchrl.evaluation.figures import new_figure, saved, trim
from lw_torchrl.language.queries import Clause
from lw_torchrl.language.tasks import task_id
from lw_torchrl.modules import ImageQueryEvaluator
from lw_torchrl.modules.parts import evaluating
from lw_torchrl.modules.query_evaluator import ClauseEvaluator, evaluators_of
from lw_torchrl.training import LabelledQueries
from lw_torchrl.transforms.qaf import plan_program

BINS = 15


def write_report(evaluator: ClauseEvaluator, data: LabelledQueries, file: Path, most: int) -> str:
    """Write the score with calibration to a .json file, and the reliability figure next to it; return a table."""
    score, bins = score_evaluator(evaluator, data), reliability(evaluator, data)
    errors = {part: calibration_error(counts) for part, counts in bins.items()}
    parts = {part: found.to_json() | {"calibration_error": errors[part]} for part, found in score.parts.items()}
    write_json(file, {"about": score.about, "parts": parts})
    plot_reliability(bins, file.with_suffix(".png"))
    lines = [f"calibration error, {PARTS[part]}: {error:.4f}" for part, error in errors.items()]
    return "\n".join([score.table(most), *lines])


@torch.no_grad()
def reliability(evaluator: ClauseEvaluator, data: LabelledQueries) -> dict[str, Tensor]:
    """Return (15, 3) float64 for each held-out part. Answers are binned by probability, in bins of equal width; the
    columns are the number of answers in a bin, the sum of their probabilities, and the number that are true."""
    parts: dict[str, Tensor] = {}
    for part in PARTS:
        for asked in data.parts[part]:
            counts = parts.setdefault(part, torch.zeros(BINS, 3, dtype=torch.float64))
            with evaluating(evaluator):
                logits, truth = clause_logits(evaluator, asked)
            probability = logits.double().sigmoid().reshape(-1)
            place = (probability * BINS).long().clamp(max=BINS - 1)
            entries = (torch.ones_like(probability), probability, truth.reshape(-1).double())
            counts.index_add_(0, place, torch.stack(entries, -1))
    return parts


def calibration_error(counts: Tensor) -> float:
    """Return the expected calibration error of the bins of :func:`reliability`."""
    number, probability, true = counts.unbind(-1)
    return ((probability - true).abs().sum() / number.sum()).item()


def plot_reliability(bins: Mapping[str, Tensor], path: Path) -> None:
    """For each held-out part, draw the fraction of true answers and the number of answers by predicted probability."""
    figure = new_figure(4.2 * len(bins), 5.0)
    both = figure.subplots(2, len(bins), squeeze=False, sharex=True, height_ratios=(3, 1))
    for (part, counts), upper, lower in zip(bins.items(), *both, strict=True):
        number, probability, true = counts.numpy().T
        there = number > 0
        upper.plot([0, 1], [0, 1], color="#bab0ac", linewidth=1)
        upper.plot(probability[there] / number[there], true[there] / number[there], "o-", color="#4c78a8", markersize=4)
        upper.set_title(f"{PARTS[part]}\ncalibration error {calibration_error(counts):.4f}", fontsize=9)
        upper.set_ylabel("fraction true")
        lower.bar([(place + 0.5) / BINS for place in range(BINS)], number, width=0.9 / BINS, color="#4c78a8")
        lower.set_yscale("log")
        lower.set_ylabel("answers")
        lower.set_xlabel("probability")
        for axes in (upper, lower):
            trim(axes)
    saved(figure, path)


@dataclass(frozen=True)
class WrongAnswer:
    """A wrong answer of an evaluator of pictures: the clause, its truth value, the predicted probability, the
    ``pixels`` (H, W·C, 3) uint8, and the errors in metres of the positions of objects that the network locates."""

    clause: Clause
    holds: bool
    believed: float
    pixels: Tensor
    off: dict[str, float]


def wrong_answers(evaluator: ImageQueryEvaluator, data: LabelledQueries, most: int = 12) -> list[WrongAnswer]:
    """Return the most confident wrong answers in held-out states, at most one per clause and ``most`` in all."""
    wrong = []
    with torch.no_grad(), evaluating(evaluator):
        for asked in data.parts["states"]:
            logits, truth = clause_logits(evaluator, asked)
            believed = logits.sigmoid()
            surest = (believed - truth.float()).abs().argmax(0).tolist()  # per clause
            for column, (row, clause) in enumerate(zip(surest, asked.clauses, strict=True)):
                probability, holds = float(believed[row, column]), bool(truth[row, column])
                if (probability > 0.5) == holds:
                    continue
                pixels, off = asked.view("pixels")[row], {}
                if evaluator.names:
                    places, _ = evaluator.network.places(pixels[None], evaluator.network.names.weight)
                    true = asked.task.positions(asked.observation[row])
                    for name in filter(None, (clause.subject, clause.object)):
                        off[name] = float((places[0, evaluator.names.index(name), :3] - true[name]).norm())
                wrong.append(WrongAnswer(clause, holds, probability, pixels, off))
    return sorted(wrong, key=lambda answer: -abs(answer.believed - answer.holds))[:most]


def plot_wrong_answers(wrong: Sequence[WrongAnswer], path: Path) -> None:
    """Draw wrong answers: the picture, the clause, and the error of the objects' positions."""
    columns = min(3, max(1, len(wrong)))
    rows = max(1, -(-len(wrong) // columns))
    figure = new_figure(3.9 * columns, 2.7 * rows)
    figure.set_layout_engine(ConstrainedLayoutEngine(h_pad=0.12))
    panels = figure.subplots(rows, columns, squeeze=False).reshape(-1)
    for axes in panels:
        axes.axis("off")
    for axes, answer in zip(panels, wrong, strict=False):
        axes.imshow(answer.pixels.numpy())
        said = f"{answer.clause}: {'holds' if answer.holds else 'does not hold'}, probability {answer.believed:.2f}"
        axes.set_title(fill(said, 44), fontsize=8)
        off = ", ".join(f"{name} {100 * far:.1f} cm off" for name, far in answer.off.items())
        axes.text(0.5, -0.03, off, transform=axes.transAxes, ha="center", va="top", fontsize=8, color="#b04a3a")
    saved(figure, path)


@dataclass(frozen=True)
class Drift:
    """The drift of an evaluator's answers to a step's condition from the exact answers.

    The fields are the fractions of ``states`` in which the condition is true (``exact``), in which the evaluator
    predicts that it is true (``believed``), and in which both agree (``agreement``).
    """

    task: str
    step: int
    condition: str
    states: int
    exact: float
    believed: float
    agreement: float


def condition_drift(policy: Any, states: TensorDictBase) -> list[Drift]:
    """Compare the answers of an evaluator, or of the evaluator in a policy, with the exact answers.

    The condition with the lowest agreement comes first.

    Args:
        policy: an evaluator, or a policy that contains an evaluator.
        states: (R,) rows with ``observation``, ``task_id`` and the evaluator's inputs.
    """
    (evaluator,) = evaluators_of(policy)
    program, drifts = plan_program(evaluator.plans), []
    for task, plan in evaluator.plans.items():
        rows = states[states.get("task_id") == task_id(task)]
        if not len(rows):
            continue
        with torch.no_grad(), evaluating(evaluator):
            believed = evaluator.logits_of(rows) > 0
        exact = program(rows.get("observation"), rows.get("task_id"))
        rates = [part.double().mean(0).tolist() for part in (exact, believed, exact == believed)]
        for number, (step, *numbers) in enumerate(zip(plan.steps, *rates, strict=False)):
            drifts.append(Drift(task, number, str(step.condition), len(rows), *numbers))
    return sorted(drifts, key=lambda drift: (drift.agreement, drift.task, drift.step))


def drift_table(drifts: Sequence[Drift], most: int = 10) -> str:
    """Return a text table of the first ``most`` drifts."""
    lines = [f"{'agreement':>9} {'exact':>6} {'believed':>8}  condition"]
    for drift in drifts[:most]:
        where = f"{drift.task}, step {drift.step + 1}: {drift.condition}"
        lines.append(f"{drift.agreement:9.2f} {drift.exact:6.2f} {drift.believed:8.2f}  {where}")
    return "\n".join(lines)
