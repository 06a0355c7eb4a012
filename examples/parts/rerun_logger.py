"""RerunLogger on one of TorchRL's environments: record the tip of a pendulum."""

import torch
from torchrl.envs import PendulumEnv

from lw_torchrl import RerunLogger

rollout = PendulumEnv().rollout(20)
tip = torch.stack((rollout["th"].sin(), torch.zeros(20), rollout["th"].cos()), -1)
with RerunLogger("pendulum.rrd") as logger:
    print(logger.log_episode(rollout, task="swing", objects={"tip": tip}))
