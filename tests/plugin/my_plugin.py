"""A package that adds to the tables (test_registry.py)."""

from dataclasses import replace

import torch

import lw_torchrl as lw
from lw_torchrl.language.relations import Comparison
from lw_torchrl.modules import MLPDecoder


def make(plans, width=8):
    return lw.PlanConditionedActor(plans, decoder=MLPDecoder(width=width))


class Guess(lw.QueryEvaluator):
    def logits(self, observation, task_id):
        return torch.zeros(*task_id.shape, self.plans.num_steps)


FAR = (Comparison("xyz", ">", 0.3),)
LOUD = replace(lw.PLAN_FORMATS["basic_py"], extension="txt")


def make_suite():
    return replace(lw.suites.load_suite("metaworld"), name="metaworld")
