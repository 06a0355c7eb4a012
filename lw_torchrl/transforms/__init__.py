"""TorchRL transforms that add condition answers, pictures or task descriptions, and augmentations of datasets."""

import lw_torchrl._util.keys  # noqa: F401
from lw_torchrl.transforms.augmentation import HideOpening, JitterTarget, SwapUnmentioned
from lw_torchrl.transforms.camera import CameraTransform
from lw_torchrl.transforms.environment import EnvState, LanguageInstruction
from lw_torchrl.transforms.fallback_turns import FallbackTurns
from lw_torchrl.transforms.qaf import CorruptQAF, QAFTransform
from lw_torchrl.transforms.random_yaw import RandomYaw
from lw_torchrl.transforms.suite_transform import SuiteTransform

__all__ = [
    "CameraTransform", "CorruptQAF", "EnvState", "FallbackTurns", "HideOpening", "JitterTarget", "LanguageInstruction",
    "QAFTransform", "RandomYaw", "SuiteTransform", "SwapUnmentioned",
]  # fmt: skip
