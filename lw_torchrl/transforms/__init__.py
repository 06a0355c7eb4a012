"""TorchRL transforms: query answers for environments and replay buffers, wrong ones too, pictures, and augmentation."""

import lw_torchrl._torchrl  # noqa: F401
from lw_torchrl.transforms.camera import CameraTransform
from lw_torchrl.transforms.corrupt_qaf import CorruptQAF
from lw_torchrl.transforms.environment import EnvState
from lw_torchrl.transforms.qaf import QAFTransform
from lw_torchrl.transforms.random_yaw import RandomYaw
from lw_torchrl.transforms.suite_transform import SuiteTransform
from lw_torchrl.transforms.take_turns import TakeTurns

__all__ = ["CameraTransform", "CorruptQAF", "EnvState", "QAFTransform", "RandomYaw", "SuiteTransform", "TakeTurns"]
