"""The trunk under TorchRL's losses: PPO's actor and value on one trunk, IQL's actor and critics on their own."""

from torchrl.objectives import ClipPPOLoss, IQLLoss

import lw_torchrl as lw

plans = lw.load_plans("MT10")
actor = lw.PlanConditionedActor(plans).stochastic("tanh_normal", init_std=0.3)
ppo = ClipPPOLoss(actor, lw.modules.Value(actor.trunk))
cloned = lw.PlanConditionedActor(plans).stochastic("normal")  # IQL maximises the likelihood of the data's actions
iql = IQLLoss(cloned, lw.PlanConditionedQValue(plans), lw.PlanConditionedValue(plans))
for loss in (ppo, iql):
    print(type(loss).__name__, loss.in_keys, loss.out_keys)
