"""python -m benchmarks.across_robots POLICIES: evaluate Meta-World policies on a Fetch robot without demonstrations."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

import lw_torchrl as lw
from benchmarks.figures import markdown_table
from lw_torchrl._util.files import write_json, write_text
from lw_torchrl.language.canonical import canonical_like
from lw_torchrl.language.layout import METAWORLD, Layout
from lw_torchrl.modules import TransferredActor, plans_of
from lw_torchrl.suites import load_suite

TASKS = {"fetch/reach": "reach", "fetch/push": "push", "fetch/pick-and-place": "pick-place"}
"""Fetch's tasks and the corresponding tasks of MT10."""
METHODS = ("pcbc", "dc", "one-hot")


@dataclass(frozen=True)
class Arguments:
    """Evaluate the zero-shot policies of each method and training seed on a Fetch robot.

    PCBC policies follow Fetch's plans. A policy that is conditioned on descriptions or task ids gets the best possible
    adapter: the corresponding task of MT10, and Fetch's values at the positions where Meta-World's observation has
    them. The axes of actions are converted in the same way for all policies.
    """

    policies: tyro.conf.Positional[Path]
    """Folder `strong` of `python -m benchmarks.paper zero-shot`."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the trained policies."""
    methods: tuple[str, ...] = METHODS
    """Methods to evaluate: pcbc, dc, one-hot."""
    episodes: int = 50
    """Number of episodes per task."""
    seed: int = 3000
    """Random seed of the episodes."""
    max_steps: int = 50
    """Number of steps per episode; success at any step counts."""
    out: Path = Path("runs/across_robots")
    """Folder for results.json and table.md."""


class Adapted(TensorDictModuleBase):
    """A wrapper of a policy without plans that converts Fetch's observations to Meta-World's."""

    def __init__(self, actor: TensorDictModuleBase, turned: Any) -> None:
        super().__init__()
        self.in_keys, self.out_keys = ["observation", "task_id"], ["action"]
        self.actor, self.turned = actor, turned
        self.tasks, self.layout = tuple(TASKS), load_suite("fetch").layout
        self.task_ids = {lw.task_id(there): lw.task_id(here) for there, here in TASKS.items()}

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        seen = tensordict.select("observation", "task_id")
        seen["observation"] = as_metaworld(seen["observation"], load_suite("fetch").layout)
        seen["task_id"] = seen["task_id"].clone().apply_(self.task_ids.__getitem__)
        return tensordict.set("action", self.turned(self.actor(seen)["action"]))


def as_metaworld(observation: Tensor, layout: Layout) -> Tensor:
    """Convert observations (B, D) of a layout with one object to Meta-World's observations (B, 39)."""
    seen = observation.new_zeros(len(observation), METAWORLD.size)
    for here, there in zip(layout.present, METAWORLD.present, strict=False):  # Meta-World has a second object
        seen[:, there] = observation[:, here]
        seen[:, METAWORLD.a_step_before(there)] = observation[:, layout.a_step_before(here)]
    seen[:, METAWORLD.goal : METAWORLD.goal + 3] = observation[:, layout.goal : layout.goal + 3]
    return seen


def main(arguments: Arguments) -> None:
    plans = lw.Plans([load_suite("fetch").plans[task] for task in TASKS])
    rows, found = [], {}
    for method in arguments.methods:
        for seed in arguments.seeds:
            followed = trained(arguments.policies, "pcbc", seed)
            turner = TransferredActor(followed, canonical_like(plans, plans_of(followed)))
            actor = turner if method == "pcbc" else Adapted(trained(arguments.policies, method, seed), turner.converted)
            how: dict[str, Any] = {"tasks": list(TASKS), "episodes_per_task": arguments.episodes}
            how |= {"seed": arguments.seed, "max_steps": arguments.max_steps, "noise_scale": 0.0}
            result = lw.evaluate(actor, **how)
            found[f"{method}, seed {seed}"] = {"once": result.success_once, "at end": result.success_at_end}
            rows.append([method, str(seed), *(f"{result.success_once[task]:.2f}" for task in TASKS)])
            print(*rows[-1], flush=True)
    table = markdown_table(["method", "training seed", *TASKS], rows)
    write_json(arguments.out / "results.json", found)
    write_text(arguments.out / "table.md", table)
    print(table)


def trained(folder: Path, method: str, seed: int) -> Any:
    """Load a policy written by `python -m benchmarks.paper zero-shot`."""
    return lw.load_actor(folder / method / f"seed{seed}" / "policy.safetensors").eval()


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(tyro.cli(Arguments))
