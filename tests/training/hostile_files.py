"""A good policy file, taken apart and written again as an attacker would."""

from __future__ import annotations

import json
import zipfile
from hashlib import sha256

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

import lw_torchrl as lw

PLANS = lw.load_plans("MT10")
SMALL = dict(latent_size=4, width=16, depth=1, encoder_width=8)
CONFIG = lw.BehavioralCloningConfig(steps=5, batch_size=8)


class Evil:
    """Unpickled, it leaves a trace."""

    def __init__(self, trace):
        self.trace = str(trace)

    def __reduce__(self):
        return (open, (self.trace, "w"))


def make_trainer(path, actor=None):
    rows = 40
    generator = torch.Generator().manual_seed(0)
    data = TensorDict(
        {
            "observation": torch.rand(rows, 39, generator=generator),
            "task_id": torch.tensor([lw.task_id(task) for task in ("push", "reach")]).repeat(rows // 2),
            "qaf": torch.rand(rows, PLANS.num_steps, generator=generator) > 0.5,
            "action": torch.rand(rows, 4, generator=generator) - 0.5,
        },
        [rows],
    )
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(rows), sampler=lw.TaskBalancedSampler())
    replay.extend(data)
    actor = lw.PlanConditionedActor(PLANS, **SMALL) if actor is None else actor
    return lw.BehavioralCloningTrainer(actor, replay, CONFIG, checkpoint=path, progress=False)


def train_good(folder):
    path = folder / "policy.zip"
    torch.manual_seed(0)
    make_trainer(path).train()
    return path


def parts(path):
    """The description and the groups of tensors of a file."""
    with zipfile.ZipFile(path) as archive:
        found = {name: archive.read(name) for name in archive.namelist()}
    return json.loads(found.pop("description.json")), found


def rebuild(path, description, groups, compression=zipfile.ZIP_STORED, text=None, signed=True):
    """Write a file as an attacker would, with sums that agree."""
    if signed and isinstance(description, dict):
        description = {**description, "sha256": {name: sha256(data).hexdigest() for name, data in groups.items()}}
    with zipfile.ZipFile(path, "w", compression) as archive:
        archive.writestr("description.json", json.dumps(description) if text is None else text)
        for name, data in groups.items():
            archive.writestr(name, data)


def refuses(path, *, training=True):
    """Loading says what is wrong, with the file's name, by every way in."""
    with pytest.raises(ValueError, match="checkpoint: ") as caught:
        lw.load_actor(path)
    assert str(path) in str(caught.value)
    if training:
        with pytest.raises(ValueError, match="checkpoint: "):
            make_trainer(path)


def said(load_one, path):
    """The documented error of loading a file; None where it loads."""
    try:
        load_one(path)
    except ValueError as error:
        return str(error)
    return None
