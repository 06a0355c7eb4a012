"""Training: behavioral cloning of one actor or of many at once, any loss over a buffer, and what they leave."""

import lw_torchrl._torchrl  # noqa: F401
from lw_torchrl.training.algorithms import LEARNERS, OnlineConfig
from lw_torchrl.training.behavioral_cloning import BehavioralCloningConfig, BehavioralCloningTrainer
from lw_torchrl.training.evaluator_training import ImageQueryEvaluatorTrainer, QueryEvaluatorTrainer
from lw_torchrl.training.files import load_actor, load_evaluator, save_actor, save_evaluator
from lw_torchrl.training.labelled_queries import ImageQueryEvaluatorConfig, LabelledQueries, QueryEvaluatorConfig
from lw_torchrl.training.normalization import fit_normalization
from lw_torchrl.training.offline import OfflineConfig, OfflineTrainer
from lw_torchrl.training.online import OnlineTrainer
from lw_torchrl.training.stacked import StackedBehavioralCloning

__all__ = [
    "LEARNERS", "BehavioralCloningConfig", "BehavioralCloningTrainer", "ImageQueryEvaluatorConfig",
    "ImageQueryEvaluatorTrainer", "LabelledQueries", "OfflineConfig", "OfflineTrainer", "OnlineConfig", "OnlineTrainer",
    "QueryEvaluatorConfig", "QueryEvaluatorTrainer", "StackedBehavioralCloning", "fit_normalization", "load_actor",
    "load_evaluator", "save_actor", "save_evaluator",
]  # fmt: skip
