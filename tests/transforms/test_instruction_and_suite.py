"""LanguageInstruction and SuiteTransform: what they write into the rows of environments and buffers."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import SerialEnv, TransformedEnv, check_env_specs

import lw_torchrl as lw
from lw_torchrl.transforms import LanguageInstruction, SuiteTransform


def make():
    return TransformedEnv(lw.LanguageWorldEnv(["reach", "push"], num_envs=3, max_steps=4), LanguageInstruction())


def test_each_row_has_its_description_at_each_step():
    env, texts = make(), [lw.TASKS[task].description for task in ("push", "reach", "push")]
    rollout = env.rollout(3)
    assert env.reset()["language_instruction"] == texts
    assert [row[0] for row in rollout["language_instruction"]] == texts
    assert [row[-1] for row in rollout["next", "language_instruction"]] == texts
    env.close()


ENVS = {
    "one": make,
    "without rows": lambda: TransformedEnv(lw.LanguageWorldEnv("reach", batch_size=()), LanguageInstruction()),
    "serial": lambda: SerialEnv(2, make),
    "around serial": lambda: TransformedEnv(SerialEnv(2, lambda: lw.LanguageWorldEnv("reach")), LanguageInstruction()),
}


@pytest.mark.parametrize("name", ENVS)
def test_specs(name):
    env = ENVS[name]()
    check_env_specs(env)
    env.close()


def test_buffer_rows_have_the_descriptions_of_their_tasks():
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(6), batch_size=6, transform=LanguageInstruction("MT10"))
    ids = torch.tensor([lw.task_id("push"), lw.task_id("door-open")]).repeat(3)
    replay.extend(TensorDict(task_id=ids, batch_size=[6]))
    result = replay.sample()
    names = {lw.task_id(task): lw.TASKS[task].description for task in lw.MT10}
    assert result["language_instruction"] == [names[number] for number in result["task_id"].tolist()]
    with pytest.raises(ValueError, match="is not among the tasks of LanguageInstruction: pass tasks="):
        LanguageInstruction("MT10")(TensorDict(task_id=torch.full((2,), lw.task_id("soccer")), batch_size=[2]))


def forgetful(observation):
    """Return Meta-World's numbers without those of the previous step."""
    seen = observation.clone()
    seen[..., 18:36] = torch.nan
    return seen


def make_suite(**options):
    env = lw.LanguageWorldEnv("push", num_envs=2, max_steps=9)
    return TransformedEnv(env, SuiteTransform(lw.TASKS["push"], forgetful, **options))


def test_numbers_of_the_previous_step_are_filled_in():
    env = make_suite()
    check_env_specs(env)
    rollout = env.rollout(9)
    env.close()
    seen = rollout["next", "observation"]
    assert torch.equal(seen[..., 18:36], rollout["observation"][..., :18])
    first = rollout["observation"][:, 0]
    assert torch.equal(first[:, 18:36], first[:, :18]), "at a reset they are those of now"
    assert (rollout["task_id"] == lw.task_id("push")).all()


def test_action_is_converted_only_for_the_environment():
    env = make_suite(act=lambda action: -action)
    state = env.reset()
    state["action"] = torch.tensor([[0.5, -0.25, 0.0, 1.0]] * 2)
    after = env.step(state)
    assert torch.equal(after["next", "executed_action"], -state["action"])
    assert torch.equal(after["action"], state["action"])
    assert env.action_spec.shape == (2, 4)
    env.close()
