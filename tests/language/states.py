"""States for queries, random ones near the thresholds and those of Meta-World's episodes; relations one by one."""

from __future__ import annotations

import functools
import random
import warnings

import numpy as np
import pytest
import torch

from lw_torchrl.language.queries import supported_queries
from lw_torchrl.language.relations import RELATIONS
from lw_torchrl.language.tasks import MT50, TASKS, task_id

RANDOM, REAL = 200, 100  # states of each task


def random_states(task, seed=0, n=RANDOM):
    """Float32 states: objects within centimetres, the opening often near 0.75 and z near 0.02."""
    rng = np.random.default_rng([seed, task_id(task)])
    states = rng.uniform(-0.3, 0.9, (n, 39))
    fixed = [np.array(o.position) for o in TASKS[task].objects if all(isinstance(c, float) for c in o.position)]
    anchor = rng.uniform([-0.5, 0.4, 0.0], [0.5, 1.0, 0.4], (n, 3))
    if task == "peg-insert-side":
        fixed.append(np.array([-0.35, 0.6, 0.16]))
    for place in fixed:
        chosen = rng.random(n) < 0.7
        anchor[chosen] = place
    for start in (0, 4, 11, 36):
        spread = rng.choice([0.01, 0.02, 0.06, 0.15], (n, 1))
        offset = rng.normal(0, spread, (n, 3))
        # Along one axis alone, so that the narrow relations hold too.
        along = rng.random(n) < 0.4
        axis = np.zeros((n, 3))
        axis[np.arange(n), rng.integers(0, 3, n)] = rng.choice([-1.0, 1.0], n) * rng.uniform(0, 0.3, n)
        offset[along] = axis[along] + rng.normal(0, 0.005, (along.sum(), 3))
        states[:, start : start + 3] = anchor + offset
        low = rng.random(n) < 0.2
        states[low, start + 2] = rng.normal(0.02, 0.003, low.sum())
    if task == "peg-insert-side":
        states[:, 37] = anchor[:, 1] + rng.normal(0, 0.02, n)
    states[:, 3] = np.where(rng.random(n) < 0.5, rng.normal(0.75, 0.02, n), rng.uniform(0, 1, n))
    return states.astype(np.float32)


@functools.cache
def real_states(task, n=REAL):
    """Every second state of one of Meta-World's episodes, float32, the expert acting with noise."""
    policies = pytest.importorskip("metaworld.policies").ENV_POLICY_MAP
    from lw_torchrl.suites.metaworld.environments import make_metaworld_env

    rng = np.random.default_rng(task_id(task))
    env, expert = make_metaworld_env(task), policies[f"{task}-v3"]()
    env.seed(task_id(task))
    observation, _ = env.reset()
    states = []
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=r"Constant\(s\) may be too high")
        for _ in range(2 * n):
            states.append(observation)
            action = expert.get_action(observation).clip(-1, 1) + rng.normal(0, 0.2, 4)
            observation = env.step(action.clip(-1, 1).astype(np.float32))[0]
    env.close()
    return np.stack(states[::2]).astype(np.float32)


def observation(**at):
    """A state of zeros but for what is named."""
    state = torch.zeros(39)
    for name, value in at.items():
        start = {"hand": 0, "opening": 3, "one": 4, "two": 11, "goal": 36}[name]
        value = torch.as_tensor(value).reshape(-1)
        state[start : start + len(value)] = value
    return state


@functools.cache
def all_tasks():
    """All 50 tasks with lists of different lengths, and a mixed batch."""
    rng = random.Random(0)
    queries = {}
    for rank, task in enumerate(MT50):
        base = list(supported_queries(task))
        queries[task] = [*rng.sample(base, 1 + rank % 9), " and ".join(rng.sample(base, 1 + rank % 4))]
    ids = torch.randint(50, (600,), generator=torch.Generator().manual_seed(0))
    ids[:50] = torch.arange(50)
    states = torch.stack(
        [torch.from_numpy(random_states(MT50[i], seed=3, n=30))[row % 30] for row, i in enumerate(ids.tolist())]
    )
    return queries, states, ids


def comparison_holds(part, d):
    """Return whether a Comparison of d is true: (..., 3) metres to (...) bool."""
    values = [d[..., "xyz".index(axis)] + (part.raise_z if axis == "z" else 0.0) for axis in part.axes]
    value = torch.stack([x.square() for x in values]).sum(0).sqrt() if part.length else values[0]
    if part.sense == "<":
        return value < part.threshold
    return value > part.threshold if part.sense == ">" else value <= part.threshold


def relation_holds(relation, first, second):
    """Return whether a relation is true of two positions: (..., 3) float, metres, to (...) bool."""
    return torch.stack([comparison_holds(part, first - second) for part in RELATIONS[relation]]).all(0)
