"""TorchRL transforms that write truth values of conditions, pictures or task descriptions, or augment sampled rows."""

import lw_torchrl._util.keys  # noqa: F401
from lw_torchrl.transforms.augmentation import JitterTarget, SwapUnmentioned
from lw_torchrl.transforms.fallback_turns import FallbackTurns
from lw_torchrl.transforms.observations import CameraTransform, LanguageInstruction, SuiteTransform
from lw_torchrl.transforms.qaf import CorruptQAF, QAFTransform
from lw_torchrl.transforms.random_yaw import RandomYaw

__all__ = [
    "CameraTransform", "CorruptQAF", "FallbackTurns", "JitterTarget", "LanguageInstruction", "QAFTransform",
    "RandomYaw", "SuiteTransform", "SwapUnmentioned",
]  # fmt: skip
