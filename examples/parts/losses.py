"""Actors and critics for TorchRL's losses: with a shared trunk for PPO, and with separate trunks for IQL."""

from torchrl.objectives import ClipPPOLoss, IQLLoss

import lw_torchrl as lw

plans = lw.load_plans("MT10")
actor = lw.PlanConditionedActor(plans).stochastic("tanh_normal", init_std=0.3)
ppo = ClipPPOLoss(actor, lw.modules.Value(actor.trunk))
cloned = lw.PlanConditionedActor(plans).stochastic("normal")  # IQL maximizes the likelihood of the data's actions
iql = IQLLoss(cloned, lw.PlanConditionedQValue(plans), lw.PlanConditionedValue(plans))
for loss in (ppo, iql):
    print(type(loss).__name__, loss.in_keys, loss.out_keys)
