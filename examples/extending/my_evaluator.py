"""A custom query evaluator: truth values are soft near the thresholds of conditions, with a learned temperature.

lw-torchrl collect reach window-open --episodes 2 --out demos
lw-torchrl train demos --out policy.safetensors --steps 300 --evaluator my_evaluator:SoftTruth
lw-torchrl evaluate policy.safetensors --episodes 2 --import my_evaluator
"""

import torch
from torch import nn

import lw_torchrl as lw


class SoftTruth(lw.QueryEvaluator):
    def __init__(self, plans, temperature=1.0, **options):
        super().__init__(plans, **options)
        self.config = {**self.config, "temperature": temperature}  # arguments to rebuild the module from a file
        conditions = {plan.definition: [step.condition for step in plan.steps] for plan in plans.values()}
        self.program = lw.QueryProgram(conditions)
        self.scale = nn.Parameter(torch.tensor(temperature).log())

    def logits(self, observation, task_id):  # (B, 39) float32 and (B,) int64 -> (B, steps of the longest plan) float32
        return self.program.logits(observation, task_id) / self.scale.exp()
