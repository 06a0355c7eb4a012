"""QAFTransform on another environment: check the plan's conditions in Meta-World's own gymnasium environment."""

import gymnasium
import metaworld  # noqa: F401 - registers the environments
import torch
from torchrl.envs import GymWrapper, TransformedEnv

import lw_torchrl as lw

reach = torch.tensor(lw.task_id("reach"))
env = GymWrapper(gymnasium.make("Meta-World/MT1", env_name="reach-v3", seed=0))
env = TransformedEnv(env, lambda td: td.set("task_id", reach))
env.append_transform(lw.QAFTransform(lw.load_plans("MT10")))
print(env.rollout(5)["qaf"])
