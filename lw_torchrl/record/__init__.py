"""Recordings to look at: a torchrl Logger that writes rerun files, and the viewer that opens them.

Importing this package loads no rerun; constructing a :class:`RerunLogger` does.
"""

import lw_torchrl._torchrl  # noqa: F401
from lw_torchrl.record.rerun_logger import RerunLogger
from lw_torchrl.record.rollout_pages import log_rollout
from lw_torchrl.record.rollout_recorder import RolloutRecorder
from lw_torchrl.record.viewer import open_viewer

__all__ = ["RerunLogger", "RolloutRecorder", "log_rollout", "open_viewer"]
