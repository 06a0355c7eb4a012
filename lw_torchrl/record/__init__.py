"""Rerun recordings: a TorchRL logger that writes recordings, and a function that opens recordings in a viewer.

Importing this package does not import rerun; creating a :class:`RerunLogger` does.
"""

import lw_torchrl._util.keys  # noqa: F401
from lw_torchrl.record.rerun_logger import RerunLogger
from lw_torchrl.record.rollout_recorder import RolloutRecorder
from lw_torchrl.record.rollouts import log_rollout
from lw_torchrl.record.viewer import open_viewer

__all__ = ["RerunLogger", "RolloutRecorder", "log_rollout", "open_viewer"]
