"""Training: behavioral cloning, and the checkpoints that it leaves."""

from lw_torchrl.trainers.behavioral_cloning import BehavioralCloningConfig, BehavioralCloningTrainer
from lw_torchrl.trainers.checkpoint import load_actor

__all__ = ["BehavioralCloningConfig", "BehavioralCloningTrainer", "load_actor"]
