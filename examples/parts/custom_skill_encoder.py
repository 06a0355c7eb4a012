"""A custom skill encoder: any module that maps the embeddings of K skill texts (K, 384) to latents (K, D)."""

import torch
from torchrl.envs import TransformedEnv

import lw_torchrl as lw

plans = lw.load_plans("MT10")
actor = lw.PlanConditionedActor(plans, skill_encoder=torch.nn.Linear(384, 16))
env = TransformedEnv(lw.LanguageWorldEnv("reach"), lw.QAFTransform(plans))
print(env.rollout(3, actor)["skill_latent"].shape)
