"""The samplers on a TorchRL buffer: draw equally many rows of each task, or half of the rows of a target task."""

import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from lw_torchrl import CoLearningSampler, TaskBalancedSampler, task_id

rows = TensorDict(task_id=torch.tensor([task_id("reach")] * 90 + [task_id("push")] * 10), batch_size=[100])
for sampler in (TaskBalancedSampler(), CoLearningSampler("push")):
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100), sampler=sampler, batch_size=20)
    buffer.extend(rows)
    print(type(sampler).__name__, (buffer.sample()["task_id"] == task_id("push")).sum().item(), "of 20 rows push")
