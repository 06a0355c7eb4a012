"""Training: behavioral cloning, any loss on a replay buffer, query evaluators, and checkpoint files."""

import lw_torchrl._util.keys  # noqa: F401
from lw_torchrl.training.checkpoint import load_actor, load_evaluator, save_actor, save_evaluator
from lw_torchrl.training.cloning import BehavioralCloningConfig, BehavioralCloningTrainer
from lw_torchrl.training.evaluator import QueryEvaluatorTrainer
from lw_torchrl.training.labelled_queries import ImageQueryEvaluatorConfig, LabelledQueries, QueryEvaluatorConfig
from lw_torchrl.training.normalization import fit_normalization
from lw_torchrl.training.offline import OfflineConfig, OfflineTrainer

__all__ = [
    "BehavioralCloningConfig", "BehavioralCloningTrainer", "ImageQueryEvaluatorConfig", "LabelledQueries",
    "OfflineConfig", "OfflineTrainer", "QueryEvaluatorConfig", "QueryEvaluatorTrainer", "fit_normalization",
    "load_actor", "load_evaluator", "save_actor", "save_evaluator",
]  # fmt: skip
