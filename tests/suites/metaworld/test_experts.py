"""ExpertActor gives what Meta-World's scripted policies give, clipped, and nothing else."""

from __future__ import annotations

import warnings
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from metaworld.policies import ENV_POLICY_MAP
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

import lw_torchrl as lw


@pytest.fixture(scope="module")
def states() -> Iterator[TensorDictBase]:
    """(50, 12) states of all tasks, on the way of their experts with some noise."""
    env = lw.LanguageWorldEnv("MT50", seed=1)
    expert = lw.ExpertActor("MT50")
    torch.manual_seed(0)

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set("action", expert(tensordict)["action"] + 0.3 * torch.randn(50, 4))

    yield env.rollout(36, policy)[:, ::3].select("observation", "task_id")
    env.close()


def own_action(task: str, observation: Tensor) -> np.ndarray:
    """What a fresh script of Meta-World asks for, clipped."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        action = ENV_POLICY_MAP[f"{task}-v3"]().get_action(observation.double().numpy())
    return np.clip(np.asarray(action, dtype=np.float64), -1, 1).astype(np.float32)


def test_every_task_is_its_own_script_clipped(states):
    action = lw.ExpertActor("MT50")(states.clone())["action"]
    assert action.shape == (50, 12, 4)
    assert action.dtype == torch.float32
    clipped = 0
    for row, task in enumerate(lw.MT50):
        for step in range(12):
            expected = own_action(task, states["observation"][row, step])
            assert np.array_equal(action[row, step].numpy(), expected), task
            clipped += (np.abs(expected) == 1).any()
    assert clipped > 100
    assert action.isfinite().all()
    assert action.abs().max() == 1.0


@pytest.mark.parametrize(
    "index", [(3, 5), (slice(None), 0), (slice(0, 1), 2), (slice(4, 9), slice(1, 3)), (7,)], ids=str
)
def test_any_batch_shape(states, index):
    expert = lw.ExpertActor("MT50")
    whole = expert(states.clone())["action"]
    part = states[index].clone()
    assert torch.equal(expert(part)["action"], whole[index])
    assert part["action"].shape == (*part.batch_size, 4)
    single = states["observation"][3, 5], states["task_id"][3, 5]
    alone = expert(TensorDict({"observation": single[0], "task_id": single[1]}, []))
    assert alone["action"].shape == (4,)
    assert torch.equal(alone["action"], whole[3, 5])


def test_rows_do_not_feel_one_another(states):
    """The scripts keep no memory, so neither the order nor the company of rows matters."""
    expert = lw.ExpertActor("MT50")
    flat = states.flatten(0, 1)
    whole = expert(flat.clone())["action"]
    order = torch.randperm(len(flat), generator=torch.Generator().manual_seed(0))
    assert torch.equal(expert(flat[order].clone())["action"], whole[order])


@pytest.mark.parametrize("shape", [(50,), (50, 1)], ids=str)
def test_rows_that_a_step_mask_leaves_out_get_zeros(states, shape):
    expert = lw.ExpertActor("MT50")
    now = states[:, 3]
    whole = expert(now.clone())["action"]
    mask = torch.arange(50) % 3 == 0
    got = expert(now.clone().set("_step", mask.reshape(shape)))["action"]
    assert torch.equal(got[mask], whole[mask])
    assert not got[~mask].any()


def test_a_row_left_out_may_hold_anything(states):
    expert = lw.ExpertActor(["reach"])
    reach = lw.task_id("reach")
    now = states[:, 3].clone()
    now["observation"][now["task_id"] != reach] = float("nan")
    got = expert(now.set("_step", now["task_id"] == reach))["action"]
    assert np.array_equal(got[reach].numpy(), own_action("reach", states["observation"][reach, 3]))
    assert got.isfinite().all()


def test_no_warning_leaks_and_none_is_turned_off(states):
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


def test_it_reads_the_state_and_writes_the_action_clipped_and_not(states):
    expert = lw.ExpertActor("MT50")
    assert expert.in_keys == ["observation", "task_id"]
    assert expert.out_keys == ["action", "unclipped_action"]
    given = states[:, 0].clone()
    out = expert(given)
    assert set(out.keys()) == {"observation", "task_id", "action", "unclipped_action"}
    assert torch.equal(out["action"], out["unclipped_action"].clamp(-1, 1))
    assert out["unclipped_action"].abs().max() > 1
    assert torch.equal(out["observation"], states["observation"][:, 0])


def test_experts_succeed():
    tasks = ["button-press-topdown", "door-close", "drawer-close", "handle-press", "reach", "window-open"]
    env = lw.LanguageWorldEnv(tasks, num_envs=12, seed=0)
    rollout = env.rollout(150, lw.ExpertActor(tasks))
    assert rollout["next", "success"].any(1).all()
    env.close()


def test_a_task_id_that_is_not_its_own_is_named():
    expert = lw.ExpertActor(["reach", "push"])
    data = TensorDict({"observation": torch.zeros(2, 39), "task_id": torch.tensor([lw.task_id("reach"), 0])}, [2])
    with pytest.raises(ValueError, match="task_id 0 is none of this expert's tasks: push, reach"):
        expert(data)
    for wrong in (50, -1):
        data["task_id"][1] = wrong
        with pytest.raises(ValueError, match=f"task_id {wrong} is none"):
            expert(data)


def test_as_many_task_ids_as_observations():
    data = TensorDict({"observation": torch.zeros(2, 3, 39), "task_id": torch.zeros(2, dtype=torch.int64)}, [2])
    with pytest.raises(ValueError, match="task_id"):
        lw.ExpertActor("MT50")(data)
