"""The environment that several test files step, on each engine."""

from collections.abc import Iterator

import pytest
from rows import ENGINES, FEW, ROWS, STEPS
from torchrl.envs import TransformedEnv

import lw_torchrl as lw


@pytest.fixture(scope="module", params=ENGINES)
def env(request) -> Iterator[lw.LanguageWorldEnv]:
    """Two rows of each of three tasks, episodes of twelve steps."""
    env = lw.LanguageWorldEnv(FEW, num_envs=ROWS, seed=0, max_steps=STEPS, reward="dense", engine=request.param)
    yield env
    env.close()


@pytest.fixture(scope="module", params=["plain", "transformed"])
def any_env(request, env, plans) -> lw.LanguageWorldEnv | TransformedEnv:
    """The same environment, plain and with a QAFTransform."""
    return env if request.param == "plain" else TransformedEnv(env, lw.QAFTransform({t: plans[t] for t in FEW}))
