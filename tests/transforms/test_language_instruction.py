"""LanguageInstruction: the task's description, under TorchRL's key, in environments and buffers."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

import lw_torchrl as lw
from lw_torchrl.transforms import LanguageInstruction


def make():
    return TransformedEnv(lw.LanguageWorldEnv(["reach", "push"], num_envs=3, max_steps=4), LanguageInstruction())


TEXTS = [lw.TASKS[task].description for task in ("push", "reach", "push")]


def test_each_row_has_its_description_at_each_step():
    env = make()
    rollout = env.rollout(3)
    assert env.reset()["language_instruction"] == TEXTS
    assert [row[0] for row in rollout["language_instruction"]] == TEXTS
    assert [row[-1] for row in rollout["next", "language_instruction"]] == TEXTS
    env.close()


@pytest.mark.parametrize(
    "batched",
    [
        lambda: make(),
        lambda: TransformedEnv(lw.LanguageWorldEnv("reach", batch_size=()), LanguageInstruction()),
        lambda: SerialEnv(2, make),
        lambda: TransformedEnv(SerialEnv(2, lambda: lw.LanguageWorldEnv(["reach", "push"])), LanguageInstruction()),
    ],
    ids=["one", "without rows", "serial", "around serial"],
)
def test_specs(batched):
    env = batched()
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
