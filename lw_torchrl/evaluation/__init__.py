"""Evaluation: run a fixed number of episodes per task, report and plot results, and find out why episodes failed."""

import lw_torchrl._util.keys  # noqa: F401
from lw_torchrl.evaluation.diagnose.attribution import attribute_failures
from lw_torchrl.evaluation.diagnose.failure import CAUSES, Failure, MendedEpisode
from lw_torchrl.evaluation.evaluator_score import EvaluatorScore, score_evaluator
from lw_torchrl.evaluation.figures import plot_failures, plot_success
from lw_torchrl.evaluation.hub import describe_policy, from_pretrained, policy_card, push_to_hub, save_pretrained
from lw_torchrl.evaluation.plan_use import PlanUse
from lw_torchrl.evaluation.protocol import evaluate
from lw_torchrl.evaluation.result import EpisodeResult, EvaluationResult

__all__ = [
    "CAUSES", "EpisodeResult", "EvaluationResult", "EvaluatorScore", "Failure", "MendedEpisode", "PlanUse",
    "attribute_failures", "describe_policy", "evaluate", "from_pretrained", "plot_failures", "plot_success",
    "policy_card", "push_to_hub", "save_pretrained", "score_evaluator",
]  # fmt: skip
