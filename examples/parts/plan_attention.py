"""PlanAttention on a tensor: the attention over a plan's steps if only the second step's condition is true."""

import torch

import lw_torchrl as lw

plans = lw.load_plans("MT10")
qaf = torch.zeros(1, plans.num_steps, dtype=torch.bool)
qaf[0, 1] = True
weights = lw.modules.PlanAttention(plans)(qaf=qaf, task_id=torch.tensor([lw.task_id("push")]))
for step, weight in zip(plans["push"].steps, weights[0], strict=False):
    print(f"{weight:.3f}  {step.skill}")
