"""ExpertActor against Meta-World's scripted policies."""

import warnings
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from metaworld.policies import ENV_POLICY_MAP
from tensordict import TensorDictBase
from torch import Tensor

import lw_torchrl as lw


@pytest.fixture(scope="module")
def states() -> Iterator[TensorDictBase]:
    """(50, 12) states of all tasks, along noisy episodes of their experts."""
    env = lw.LanguageWorldEnv("MT50", seed=1)
    expert = lw.ExpertActor("MT50")
    torch.manual_seed(0)

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set("action", expert(tensordict)["action"] + 0.3 * torch.randn(50, 4))

    yield env.rollout(36, policy)[:, ::3].select("observation", "task_id")
    env.close()


def script_action(task: str, observation: Tensor) -> np.ndarray:
    """Return the clipped action of a new script of Meta-World."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        action = ENV_POLICY_MAP[f"{task}-v3"]().get_action(observation.double().numpy())
    return np.clip(np.asarray(action, dtype=np.float64), -1, 1).astype(np.float32)


def test_actions_are_those_of_each_tasks_script_clipped(states):
    actions = lw.ExpertActor("MT50")(states.clone())
    assert {*actions.keys()} == {"observation", "task_id", "action", "unclipped_action"}
    assert torch.equal(actions["observation"], states["observation"])
    action, unclipped = actions["action"], actions["unclipped_action"]
    assert (action.shape, action.dtype) == ((50, 12, 4), torch.float32)
    clipped = 0
    for row, task in enumerate(lw.MT50):
        for step in range(12):
            expected = script_action(task, states["observation"][row, step])
            assert np.array_equal(action[row, step].numpy(), expected), task
            clipped += (np.abs(expected) == 1).any()
    assert clipped > 100
    assert torch.equal(action, unclipped.clamp(-1, 1))
    assert unclipped.abs().max() > 1


@pytest.mark.parametrize(
    "index", [(3, 5), (slice(None), 0), (slice(0, 1), 2), (slice(4, 9), slice(1, 3)), (7,)], ids=str
)
def test_batches_have_any_shape_and_rows_do_not_affect_each_other(states, index):
    expert = lw.ExpertActor("MT50")
    whole = expert(states.clone())["action"]
    part = states[index].clone()
    assert torch.equal(expert(part)["action"], whole[index])
    assert part["action"].shape == (*part.batch_size, 4)
    flat = states.flatten(0, 1)
    order = torch.randperm(len(flat), generator=torch.Generator().manual_seed(0))
    assert torch.equal(expert(flat[order].clone())["action"], whole.flatten(0, 1)[order])


@pytest.mark.parametrize("shape", [(50,), (50, 1)], ids=str)
def test_rows_outside_a_step_mask_get_zeros(states, shape):
    expert = lw.ExpertActor("MT50")
    now = states[:, 3]
    whole = expert(now.clone())["action"]
    mask = torch.arange(50) % 3 == 0
    action = expert(now.clone().set("_step", mask.reshape(shape)))["action"]
    assert torch.equal(action[mask], whole[mask])
    assert not action[~mask].any()


def test_rows_outside_a_step_mask_may_be_of_other_tasks_and_nan(states):
    expert, reach = lw.ExpertActor(["reach"]), lw.task_id("reach")
    now = states[:, 3].clone()
    now["observation"][now["task_id"] != reach] = float("nan")
    action = expert(now.set("_step", now["task_id"] == reach))["action"]
    assert np.array_equal(action[reach].numpy(), script_action("reach", states["observation"][reach, 3]))
    assert action.isfinite().all()


def test_scripts_warnings_are_hidden_and_filters_restored(states):
    expert = lw.ExpertActor("MT50")
    filters = list(warnings.filters)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        expert(states.clone())
    assert not caught
    assert list(warnings.filters) == filters
    script, own = ENV_POLICY_MAP["push-v3"](), states["observation"][lw.task_id("push")].double().numpy()
    with pytest.warns(UserWarning, match="may be too high"):
        np.apply_along_axis(script.get_action, -1, own)
