"""Factories that worker processes import by name."""

from functools import partial

import torch
from torchrl.envs import SerialEnv, TransformedEnv

import lw_torchrl as lw


def make_env(**options) -> lw.LanguageWorldEnv:
    return lw.LanguageWorldEnv("reach", **{"num_envs": 2, "seed": 3, "max_steps": 2, "num_threads": 1} | options)


def make_transformed(**options) -> TransformedEnv:
    return TransformedEnv(make_env(**options), lw.QAFTransform(lw.load_plans("MT10")))


def make_serial(worker=(0, 1)) -> SerialEnv:
    return SerialEnv(2, numbered(make_env, 2, worker))


def numbered(make, of, worker=(0, 1), **options):
    """Return a factory for each of ``of`` workers, which may run in a worker themselves."""
    rank, outer = worker
    return [partial(make, worker=(rank * of + w, of * outer), **options) for w in range(of)]


def still(tensordict):
    return tensordict.set("action", torch.zeros(*tensordict.batch_size, 4))


def make_push_reach(worker=(0, 1)) -> TransformedEnv:
    env = lw.LanguageWorldEnv(["push", "reach"], num_envs=2, max_steps=5, num_threads=1, worker=worker)
    return TransformedEnv(env, lw.QAFTransform(lw.load_plans("MT10")))


def make_actor() -> lw.modules.StochasticActor:
    torch.manual_seed(0)
    return lw.PlanConditionedActor(lw.load_plans("MT10")).stochastic()
