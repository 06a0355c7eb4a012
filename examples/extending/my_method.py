"""A way of conditioning of your own: each task has a vector that is learned, and no words are read.

lw-torchrl collect reach window-open --episodes 2 --out demos
lw-torchrl train demos --out policy.safetensors --steps 300 --method TaskVectors --import my_method
lw-torchrl evaluate policy.safetensors --episodes 2 --import my_method
"""

from torch import nn

from lw_torchrl.language.task_index import TaskIndex
from lw_torchrl.language.tasks import named_tasks, one_layout, task_ids
from lw_torchrl.modules import ENCODERS, Encoder, Encoding, ObservationFeatures


class TaskVectors(Encoder):
    def __init__(self, tasks, *, size=16, feature_noise=0.05):
        super().__init__()
        self.definitions = named_tasks(tasks)  # name -> Task
        self.tasks, self.layout = tuple(self.definitions), one_layout(self.definitions.values())
        self.config = {"size": size, "feature_noise": feature_noise}  # makes it again, from a policy's file
        self.in_keys, self.out_keys = ["observation", "task_id"], ["encoding"]
        self.index = TaskIndex(task_ids(self.tasks))
        self.features = ObservationFeatures("differences", feature_noise, self.layout)  # (B, 39) float32 -> (B, F)
        self.vectors = nn.Embedding(len(self.tasks), size)
        self.latent_size = size

    def definition(self, task):
        return self.definitions.get(task)

    def prepare(self, tensordict):  # what no trained parameter touches, and all checks
        observation, task_id = self.read(tensordict)
        return self.index.rows(task_id, "tasks that it was not made for"), self.features(observation)

    def encode(self, rows, seen):  # what is trained
        return Encoding(latent=self.vectors.weight[rows], features=seen)


ENCODERS["TaskVectors"] = TaskVectors
