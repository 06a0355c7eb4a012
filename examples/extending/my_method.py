"""A custom method: condition the policy on a learned vector for each task, without any text.

lw-torchrl collect reach window-open --episodes 2 --out demos
lw-torchrl train demos --out policy.safetensors --steps 300 --method task-vectors --import my_method
lw-torchrl evaluate policy.safetensors --episodes 2 --import my_method
"""

from collections import OrderedDict

from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import nn

from lw_torchrl.language.task_index import TaskIndex
from lw_torchrl.modules import METHODS, ConditionedActor, ObservationFeatures


class TaskVectors(TensorDictModuleBase):
    def __init__(self, task_ids, size=16):
        super().__init__()
        self.config = {"task_ids": dict(task_ids), "size": size}  # arguments to rebuild the module from a file
        self.in_keys, self.out_keys = ["task_id"], ["task_latent"]
        self.tasks, self.latent_size = tuple(task_ids), size
        self.index = TaskIndex(task_ids)
        self.vectors = nn.Embedding(len(task_ids), size)

    def forward(self, tensordict):  # task_id (B,) int64 -> task_latent (B, size) float32
        rows = self.index.rows(tensordict["task_id"], "tasks that this policy was not trained on")
        return tensordict.set("task_latent", self.vectors(rows))


def task_vectors(plans, *, features=None, decoder=None, text_encoder=None, size=16):
    latent = TaskVectors(plans.task_ids, size)
    features = features or ObservationFeatures(noise=0.05, layout=plans.layout)
    return ConditionedActor(TensorDictSequential(OrderedDict(latent=latent, features=features)), decoder)


METHODS["task-vectors"] = task_vectors
