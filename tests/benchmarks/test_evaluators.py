"""The experiment with learned evaluators: plans as programs."""

from pathlib import Path

import torch
from tensordict import TensorDict

import benchmarks
import lw_torchrl as lw
from benchmarks.evaluators import load_plans
from lw_torchrl.transforms.qaf import plan_program

TREES = load_plans(str(Path(benchmarks.__file__).parent / "data" / "tree_plans.toml"))
FLAT = lw.load_plans("MT10")


def _states(rows: int) -> TensorDict:
    """Draw states in which objects are a few centimetres apart, so that most conditions are true in some of them."""
    generator = torch.Generator().manual_seed(0)
    observation = 0.03 * torch.randn(rows, 39, generator=generator)
    task_id = torch.tensor([*FLAT.task_ids.values()])[torch.arange(rows) % len(FLAT)]
    return TensorDict({"observation": observation, "task_id": task_id}, [rows])


def test_programs_of_mt10_have_the_skills_of_the_shipped_plans_and_one_active_step():
    assert {*TREES} == {*lw.MT10}
    for task, plan in TREES.items():
        assert {step.skill for step in plan.steps} == {step.skill for step in FLAT[task].steps}
    assert sum(" or " in str(step.condition) for plan in TREES.values() for step in plan.steps) == 7
    states = _states(4000)
    answers = plan_program(TREES)(states["observation"], states["task_id"])
    assert (answers.sum(-1) == 1).all()  # "else" excludes all branches above it, and covers what they leave
