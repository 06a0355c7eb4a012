"""A policy with a learned evaluator, which answers the plan's conditions; one loss trains both modules."""

from tensordict.nn import TensorDictSequential

import lw_torchrl as lw

plans = lw.load_plans("MT10")
policy = TensorDictSequential(lw.modules.StateQueryEvaluator(plans), lw.PlanConditionedActor(plans))
state = lw.LanguageWorldEnv(["reach", "push"]).reset()
policy(state)["action"].square().mean().backward()
print(policy.in_keys, state["qaf"], sum(p.grad is not None for p in policy.parameters()))
