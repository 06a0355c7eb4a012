"""Small datasets and policies for the tests of collecting, the bytes of a folder, and a stop in the midst of it."""

from __future__ import annotations

import json

import torch

import lw_torchrl as lw
from lw_torchrl.data import collect_demonstrations
from lw_torchrl.data.collect import EpisodeFiles
from lw_torchrl.data.dataset import describe_episode, load_rows, read_metadata

TASKS = ("push", "reach")
NOISE = (0.0, 0.3)
STEPS, EPISODES, SEED = 14, 3, 5
PLANS = lw.load_plans("MT10")


def collect(root, tasks=TASKS, **changed):
    options = dict(episodes_per_task=EPISODES, seed=SEED, noise_scale=NOISE, max_steps=STEPS, progress=False)
    return collect_demonstrations(tasks, root=root, **{**options, **changed})


def tree(root):
    """Every file below a folder with its bytes."""
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


def restate_checksums(root):
    """Make the rows of a dataset, whatever was done to them, the ones that its metadata speak of."""
    found = read_metadata(root)
    rows = load_rows(found)
    parts = [(one, rows[one.start : one.start + one.length]) for one in found.episodes]
    stated = json.loads((root / "metadata.json").read_text())
    stated["episodes"]["checksum"] = [
        describe_episode(one.task, one.episode, one.start, part).checksum for one, part in parts
    ]
    (root / "metadata.json").write_text(json.dumps(stated))


def interrupt_after(monkeypatch, episodes):
    """Stop collecting, as Ctrl-C does, after so many episodes have been put away."""
    put, left = EpisodeFiles.put, [episodes]

    def stopping(self, *args):
        if not left[0]:
            raise KeyboardInterrupt
        left[0] -= 1
        put(self, *args)

    monkeypatch.setattr(EpisodeFiles, "put", stopping)


def trained(kind="plan", seed=0, squash=True, **options):
    """A tiny policy; of other weights for another seed."""
    torch.manual_seed(seed)
    options["decoder"] = lw.modules.MLPDecoder(width=8, depth=1, squash=squash)
    if kind == "plan":
        return lw.PlanConditionedActor(PLANS, **options)
    return lw.DescriptorConditionedActor(("push", "reach"), **options)


def same_rows(one, other):
    return (load_rows(one) == load_rows(other)).all()
