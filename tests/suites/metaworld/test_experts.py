"""ExpertActor against Meta-World's scripted policies."""

import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from metaworld.policies import ENV_POLICY_MAP
from tensordict import TensorDictBase

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


def test_actions_are_those_of_each_tasks_script_clipped(states):
    actions = lw.ExpertActor("MT50")(states.clone())
    assert {*actions.keys()} == {"observation", "task_id", "action", "unclipped_action"}
    assert torch.equal(actions["observation"], states["observation"])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rows = states["observation"].double().numpy()
        policies = [ENV_POLICY_MAP[f"{task}-v3"]() for task in lw.MT50]
        scripts = [[policy.get_action(now) for now in rows[k]] for k, policy in enumerate(policies)]
    expected = torch.from_numpy(np.clip(np.array(scripts, np.float64), -1, 1).astype(np.float32))
    assert torch.equal(actions["action"], expected)
    assert (expected.abs() == 1).any(-1).sum() > 100
    assert torch.equal(actions["action"], actions["unclipped_action"].clamp(-1, 1))
    assert actions["unclipped_action"].abs().max() > 1


@pytest.mark.parametrize("index", [(3, 5), (slice(None), 0), (slice(0, 1), 2), (slice(4, 9), slice(1, 3)), 7], ids=str)
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
@pytest.mark.parametrize("tasks", ["MT50", list(lw.MT50[::3])], ids=["all", "some"])
def test_rows_outside_a_step_mask_get_zeros(states, tasks, shape):
    """Their tasks may be unknown and their observations NaN."""
    now, mask = states[:, 3].clone(), torch.arange(50) % 3 == 0
    whole = lw.ExpertActor("MT50")(now.clone())["action"]
    now["observation"][~mask] = torch.nan
    action = lw.ExpertActor(tasks)(now.set("_step", mask.reshape(shape)))["action"]
    assert torch.equal(action, whole.where(mask[:, None], torch.zeros(())))


def test_scripts_warnings_are_hidden_and_filters_restored_in_threads(states):
    own, expert = states[lw.task_id("push")], lw.ExpertActor("push")
    with pytest.warns(UserWarning, match="may be too high"):
        np.apply_along_axis(ENV_POLICY_MAP["push-v3"]().get_action, -1, own["observation"].double().numpy())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        before = list(warnings.filters)
        with ThreadPoolExecutor(3) as threads:
            list(threads.map(lambda _: [expert(own.clone()) for _ in range(50)], range(3)))
        assert warnings.filters == before
