"""Evaluation: exactly k episodes of each task, their results and figures."""

from lw_torchrl.evaluation.evaluate import evaluate
from lw_torchrl.evaluation.figures import plot_success
from lw_torchrl.evaluation.result import EpisodeResult, EvaluationResult

__all__ = ["EpisodeResult", "EvaluationResult", "evaluate", "plot_success"]
