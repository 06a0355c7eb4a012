"""Environments and experts in several threads."""

from __future__ import annotations

import warnings
from concurrent.futures import ThreadPoolExecutor

import lw_torchrl as lw


def test_an_environment_in_each_thread_gives_what_it_gives_alone():
    def rollout(task):
        env = lw.LanguageWorldEnv(task, seed=3, num_threads=1)
        found = env.rollout(20, lw.ExpertActor(task))
        env.close()
        return found

    tasks = ["reach", "push", "reach"]
    alone = [rollout(task) for task in tasks]
    with ThreadPoolExecutor(3) as threads:
        assert all((one == other).all() for one, other in zip(alone, threads.map(rollout, tasks), strict=True))


def test_experts_in_threads_leave_pythons_warnings_alone():
    state = lw.LanguageWorldEnv("reach", num_envs=4).reset()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        before = list(warnings.filters)

        def act(_):
            expert = lw.ExpertActor("reach")
            for _ in range(200):
                expert(state.copy())

        with ThreadPoolExecutor(3) as threads:
            list(threads.map(act, range(3)))
        assert warnings.filters == before
