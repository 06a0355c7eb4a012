"""Train a policy with plain PyTorch on a dataset that was exported to LeRobot's parquet files.

python examples/plain_pytorch.py  # drawer-open, reach and window-open, under a minute; --steps 50 for a quick test
"""

import argparse
import tempfile

import numpy as np
import pyarrow.parquet as pq
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torch.utils.data import DataLoader, RandomSampler, TensorDataset

import lw_torchrl as lw

TASKS = ["drawer-open", "reach", "window-open"]


class Network(nn.Module):
    """A network that maps an observation and a task id to an action."""

    def __init__(self, observation: torch.Tensor) -> None:
        super().__init__()
        self.register_buffer("mean", observation.mean(0))
        self.register_buffer("scale", observation.std(0).clamp(min=1e-3))
        self.task = nn.Embedding(len(lw.MT50), 16)
        hidden = nn.Linear(39 + 16, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU()
        self.layers = nn.Sequential(*hidden, nn.Linear(256, 4), nn.Tanh())

    def forward(self, observation: torch.Tensor, task: torch.Tensor) -> torch.Tensor:
        normal = ((observation - self.mean) / self.scale).clamp(-5, 5)
        return self.layers(torch.cat([normal, self.task(task)], -1))


def exported_rows(root: str, demonstrations: int) -> TensorDataset:
    """Return observations, task ids and expert actions, up to 20 steps after the first success of each episode."""
    how = {"noise_scale": [0.0, 0.1, 0.2], "redraw_failures": True}
    lw.collect_demonstrations(TASKS, episodes_per_task=demonstrations, root=f"{root}/demos", **how)
    out = lw.export_dataset(f"{root}/demos", "lerobot", f"{root}/out")
    names = {row["task_index"]: row["name"] for row in pq.read_table(out / "meta/tasks.parquet").to_pylist()}
    table = pq.read_table(out / "data")
    episode, success = (table.column(name).to_numpy() for name in ("episode_index", "next.success"))
    used = np.zeros(len(table), dtype=bool)
    for rows in (np.flatnonzero(episode == number) for number in range(episode[-1] + 1)):
        used[rows[: success[rows].argmax() + 21]] = True
    columns = (table.column(name).combine_chunks() for name in ("observation.state", "expert_action"))
    observation, action = (torch.tensor(one.flatten().to_numpy().reshape(len(table), -1)[used]) for one in columns)
    task = torch.tensor([lw.task_id(names[index]) for index in table.column("task_index").to_numpy()[used]])
    return TensorDataset(observation, task, action)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    for name, default in (("steps", 3000), ("demonstrations", 20), ("episodes", 20), ("seed", 0)):
        parser.add_argument(f"--{name}", type=int, default=default)
    args = parser.parse_args()
    torch.manual_seed(args.seed)
    with tempfile.TemporaryDirectory() as root:
        rows = exported_rows(root, args.demonstrations)
    network = Network(rows.tensors[0])
    optimizer = torch.optim.AdamW(network.parameters(), lr=1e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, args.steps)
    draws = RandomSampler(rows, replacement=True, num_samples=256 * args.steps)
    for step, (observation, task, action) in enumerate(DataLoader(rows, batch_size=256, sampler=draws), 1):
        loss = nn.functional.mse_loss(network(observation, task), action)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        if step % 500 == 0:
            print(f"step {step:5}  loss {loss.item():.4f}")

    actor = TensorDictModule(network, in_keys=["observation", "task_id"], out_keys=["action"])
    print(lw.evaluate(actor, tasks=TASKS, episodes_per_task=args.episodes, seed=1_000).table())


if __name__ == "__main__":
    main()
