"""Evaluation: exactly k episodes of each task, their results, statistics over seeds, and figures."""

import lw_torchrl._torchrl  # noqa: F401
from lw_torchrl.evaluation.diagnose.attribution import attribute_failures
from lw_torchrl.evaluation.diagnose.failure import CAUSES, Failure, MendedEpisode
from lw_torchrl.evaluation.evaluator_score import EvaluatorScore, score_evaluator
from lw_torchrl.evaluation.figures import plot_failures, plot_success
from lw_torchrl.evaluation.hub import describe_policy, from_pretrained, policy_card, push_to_hub, save_pretrained
from lw_torchrl.evaluation.plan_use import PlanUse
from lw_torchrl.evaluation.protocol import evaluate
from lw_torchrl.evaluation.result import EpisodeResult, EvaluationResult
from lw_torchrl.evaluation.statistics import (
    Estimate,
    count_solved,
    interquartile_mean,
    mean_difference,
    mean_rate,
    probability_of_improvement,
)
from lw_torchrl.evaluation.summary import Summary, TaskSummary, summarize, summarize_rates

__all__ = [
    "CAUSES", "EpisodeResult", "Estimate", "EvaluationResult", "EvaluatorScore", "Failure", "MendedEpisode", "PlanUse",
    "Summary", "TaskSummary", "attribute_failures", "count_solved", "describe_policy", "evaluate", "from_pretrained",
    "interquartile_mean", "mean_difference", "mean_rate", "plot_failures", "plot_success",
    "policy_card", "probability_of_improvement", "push_to_hub", "save_pretrained", "score_evaluator",
    "summarize", "summarize_rates",
]  # fmt: skip
