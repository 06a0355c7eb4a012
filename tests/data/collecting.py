"""Small datasets and policies for the tests of this folder, and helpers on their files."""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict

import lw_torchrl as lw
from lw_torchrl._util.reproducibility import package_versions
from lw_torchrl.data import CollectConfig, Demonstrations, collect_demonstrations
from lw_torchrl.data.collect import EpisodeFiles
from lw_torchrl.data.dataset import COLUMNS, describe_episode, load_rows, read_metadata, write_metadata, write_rows
from lw_torchrl.language.tasks import task_id

TASKS = ("push", "reach")
NOISE = (0.0, 0.3)
STEPS, EPISODES, SEED = 14, 3, 5
PLANS = lw.load_plans("MT10")
ODD = np.array([0.0, -0.0, 1e-45, -1e-38, 3.4e38, np.pi, 1 / 3], dtype=np.float32)  # numbers that lose bits easily


def collect(root, tasks=TASKS, **changed):
    options = dict(episodes_per_task=EPISODES, seed=SEED, noise_scale=NOISE, max_steps=STEPS, progress=False)
    return collect_demonstrations(tasks, root=root, **{**options, **changed})


KINDS = {
    "expert": {},
    "unclipped": dict(label="unclipped"),
    "executed": dict(label="executed", reward="dense"),
    "cut": dict(label="executed", after_success=3),
    "chosen": dict(episodes=2),
    "n steps": dict(label="executed", n_steps=3, gamma=0.9),
}


def open_replay(root, kind="expert", seed=0, **options):
    defaults = dict(batch_size=8, generator=torch.Generator().manual_seed(seed))
    return lw.LanguageWorldExperienceReplay(root, **{**defaults, **KINDS[kind], **options})


def tree(root):
    """Every file below a folder with its bytes."""
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


def restate_checksums(root):
    """Write the checksums of the present rows to a dataset's metadata."""
    dataset = read_metadata(root)
    rows, episodes = load_rows(dataset), []
    for info in dataset.episodes:
        steps = rows[info.start : info.start + info.length]
        episodes.append(describe_episode(info.task, info.episode, info.start, steps))
    write_metadata(replace(dataset, episodes=tuple(episodes)))


def interrupt_after(monkeypatch, episodes):
    """Interrupt collecting, as Ctrl-C does, when ``episodes`` episodes have been written."""
    put, left = EpisodeFiles.put, [episodes]

    def stopping(self, *args):
        if not left[0]:
            raise KeyboardInterrupt
        left[0] -= 1
        put(self, *args)

    monkeypatch.setattr(EpisodeFiles, "put", stopping)


def trained(kind="plan", seed=0, squash=True, **options):
    """Return a tiny policy, with other weights for another seed."""
    torch.manual_seed(seed)
    options["decoder"] = lw.modules.MLPDecoder(width=8, depth=1, squash=squash)
    if kind == "plan":
        return lw.PlanConditionedActor(PLANS, **options)
    return lw.modules.DescriptorConditionedActor(("push", "reach"), **options)


def same_rows(left, right):
    return (load_rows(left) == load_rows(right)).all()


class Evil:
    """An object that makes a folder when it is unpickled."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


def random_dataset(root: Path, lengths: Sequence[Sequence[int]], seed: int = 0) -> Demonstrations:
    """Write a dataset of random numbers: a task for each list of episode lengths."""
    tasks = ("drawer-open", "push", "reach")[: len(lengths)]
    draws = np.random.default_rng(seed)

    def numbers(*shape: int) -> torch.Tensor:
        values = draws.standard_normal(shape).astype(np.float32)
        odd = draws.random(shape) < 0.1
        values[odd] = draws.choice(ODD, odd.sum())
        return torch.from_numpy(values)

    parts = []
    for task, of_task in zip(tasks, lengths, strict=True):
        for episode, steps in enumerate(of_task):
            states, number = numbers(steps + 1, 39), torch.full((steps,), task_id(task))
            success = torch.from_numpy(draws.random((steps, 1)) < 0.2)
            ends = torch.arange(steps)[:, None] == steps - 1
            after = {"observation": states[1:], "task_id": number, "success": success, "done": ends}
            after |= {"truncated": ends, "terminated": ends & False, "reward_sparse": success.float()}
            rows = TensorDict({key: numbers(steps, *shape) for key, (shape, _) in COLUMNS.items()}, [steps])
            rows.set("action", rows.get("action").clamp(-1, 1)).set("episode", torch.full_like(number, episode))
            rows.update({"observation": states[:-1], "task_id": number, "next": after})
            parts.append((task, episode, rows))
    config = CollectConfig(tasks, len(lengths[0]), seed, max_steps=max(map(max, lengths)))
    infos = write_rows(root / "data", parts, config.layout)
    numbers_of, attempts = {task: task_id(task) for task in tasks}, dict.fromkeys(tasks, len(lengths[0]))
    write_metadata(Demonstrations(root, config, package_versions(), numbers_of, infos, attempts))
    return read_metadata(root)
