"""Factories that worker processes import by name."""

from __future__ import annotations

import torch
from torchrl.envs import SerialEnv, TransformedEnv

import lw_torchrl as lw


def make_env(**options) -> lw.LanguageWorldEnv:
    return lw.LanguageWorldEnv("reach", **{"num_envs": 2, "seed": 3, "max_steps": 2, "num_threads": 1} | options)


def make_transformed() -> TransformedEnv:
    return TransformedEnv(make_env(), lw.QAFTransform(lw.load_plans("MT10")))


def make_serial() -> SerialEnv:
    return SerialEnv(2, make_env)


def still(tensordict):
    return tensordict.set("action", torch.zeros(*tensordict.batch_size, 4))


def make_push_reach() -> TransformedEnv:
    env = lw.LanguageWorldEnv(["push", "reach"], num_envs=2, max_steps=5, num_threads=1)
    return TransformedEnv(env, lw.QAFTransform(lw.load_plans("MT10")))


def make_single() -> TransformedEnv:
    env = make_env(num_envs=1, max_steps=5, batch_size=())
    return TransformedEnv(env, lw.QAFTransform(lw.load_plans("MT10")))


def make_actor() -> lw.modules.StochasticActor:
    torch.manual_seed(0)
    return lw.PlanConditionedActor(lw.load_plans("MT10")).stochastic()
