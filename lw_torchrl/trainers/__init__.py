"""Training: behavioral cloning of one actor or of many at once, any loss over a buffer, and what they leave."""

import lw_torchrl._torchrl  # noqa: F401
from lw_torchrl.trainers.behavioral_cloning import BehavioralCloningTrainer
from lw_torchrl.trainers.checkpoint import load_actor, save_actor
from lw_torchrl.trainers.config import BehavioralCloningConfig
from lw_torchrl.trainers.evaluator_files import load_evaluator, save_evaluator
from lw_torchrl.trainers.evaluator_training import QueryEvaluatorTrainer
from lw_torchrl.trainers.image_evaluator_training import ImageQueryEvaluatorConfig, ImageQueryEvaluatorTrainer
from lw_torchrl.trainers.labelled_queries import LabelledQueries, QueryEvaluatorConfig
from lw_torchrl.trainers.normalization import fit_normalization
from lw_torchrl.trainers.offline import OfflineConfig, OfflineTrainer
from lw_torchrl.trainers.online import LEARNERS, OnlineTrainer
from lw_torchrl.trainers.online_config import OnlineConfig
from lw_torchrl.trainers.stacked import StackedBehavioralCloning

__all__ = [
    "LEARNERS",
    "BehavioralCloningConfig",
    "BehavioralCloningTrainer",
    "ImageQueryEvaluatorConfig",
    "ImageQueryEvaluatorTrainer",
    "LabelledQueries",
    "OfflineConfig",
    "OfflineTrainer",
    "OnlineConfig",
    "OnlineTrainer",
    "QueryEvaluatorConfig",
    "QueryEvaluatorTrainer",
    "StackedBehavioralCloning",
    "fit_normalization",
    "load_actor",
    "load_evaluator",
    "save_actor",
    "save_evaluator",
]
