"""Ctrl-C in training: it ends between two steps, with a checkpoint of where it stands, every time."""

from __future__ import annotations

import random
import signal
import threading
import time
from itertools import pairwise

import pytest
import torch
from small_training import make_descriptor_actor
from torchrl.envs import Transform

import lw_torchrl as lw

CONFIG = lw.BehavioralCloningConfig(steps=40, batch_size=20, checkpoint_every=30)


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    root = tmp_path_factory.mktemp("interrupts") / "demos"
    lw.collect_demonstrations(["push", "reach"], episodes_per_task=1, root=root, max_steps=60, progress=False)
    return root


class PressCtrlC(Transform):
    """Sends SIGINT while the sixth minibatch is drawn, as often as it is told to."""

    def __init__(self, times=1):
        super().__init__()
        self.minibatches, self.presses = iter(range(1, 100)), iter(range(times))  # no numbers: all are alike

    def forward(self, tensordict):
        if next(self.minibatches) == 6:
            for _ in self.presses:
                signal.raise_signal(signal.SIGINT)
        return tensordict


def make(demos, checkpoint, *, times=0):
    replay = lw.LanguageWorldExperienceReplay(demos, sampler=lw.TaskBalancedSampler())
    replay.append_transform(PressCtrlC(times))
    actor = make_descriptor_actor(["push", "reach"])
    return lw.BehavioralCloningTrainer(actor, replay, CONFIG, checkpoint=checkpoint, progress=False)


def weights(trainer):
    return torch.cat([p.detach().flatten() for p in trainer.actor.parameters()])


def test_it_ends_after_the_step_and_carries_on(demos, tmp_path):
    handler = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        make(demos, tmp_path / "c.safetensors", times=1).train()
    assert signal.getsignal(signal.SIGINT) is handler
    resumed = make(demos, tmp_path / "c.safetensors")
    assert resumed.steps == 6
    resumed.train()
    whole = make(demos, None)
    whole.train()
    assert torch.equal(weights(resumed), weights(whole))


def test_the_second_time_it_ends_at_once(demos, tmp_path):
    trainer = make(demos, tmp_path / "c.safetensors", times=2)
    handler = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        trainer.train()
    assert signal.getsignal(signal.SIGINT) is handler
    assert trainer.steps == 5
    assert not (tmp_path / "c.safetensors").exists()


def test_where_it_is_ignored_it_is_ignored(demos, tmp_path):
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        trainer = make(demos, tmp_path / "c.safetensors", times=1)
        trainer.train()
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)
    assert trainer.steps == CONFIG.steps


def test_in_another_thread_nothing_is_changed(demos):
    trainer = make(demos, None)
    thread = threading.Thread(target=trainer.train)
    thread.start()
    thread.join()
    assert trainer.steps == CONFIG.steps


# What a command does before it works: note in a file when the work begins, and at which step.
NOTES = """
import lw_torchrl as lw

place, method, begun = getattr(lw, {owner!r}), {method!r}, {begun!r}
original = getattr(place, method)

def noted(self, *args):
    setattr(place, method, original)
    with open(begun, "w") as file:
        file.write(f"{{getattr(self, 'steps', 0)}}\\n")
    return original(self, *args)

setattr(place, method, noted)
"""


def interrupted(forks, tmp_path, arguments, runs, owner, method):
    """(exit status, step at which it began) of each run; each gets the signal at a random moment of its work."""
    begun, chance, found = tmp_path / "begun", random.Random(0), []
    for _ in range(runs):
        begun.write_text("")
        forks.start(*arguments, before=NOTES.format(owner=owner, method=method, begun=str(begun)))
        while not begun.read_text().endswith("\n"):
            assert forks.running(0.005), forks.end()
        time.sleep(chance.uniform(0, 0.15))
        forks.send(signal.SIGINT)
        ended = forks.end()
        assert "Traceback" not in ended.err
        found.append((ended.status, int(begun.read_text())))
    return found


@pytest.mark.parametrize("times", [5, pytest.param(20, marks=pytest.mark.slow)])
def test_at_random_moments(forks, demos, tmp_path, times):
    """Each run carries on from the one before; none loses a step that it made."""
    file = tmp_path / "policy.safetensors"
    arguments = ["train", demos, "--out", file, "--steps", 10**6, "--batch-size", 20, "--width", 16, "--depth", 1]
    found = interrupted(forks, tmp_path, arguments, times, "BehavioralCloningTrainer", "step")
    assert [status for status, _ in found] == [130] * times
    steps = [step for _, step in found]
    assert steps[0] == 0
    assert all(before < after for before, after in pairwise(steps)), steps


OTHERS = (
    ("collect", "reach", "push", "--out", "OUT"),
    ("evaluate", "expert", "--tasks", "reach"),
    ("demo", "--quick", "--out", "OUT"),
)


@pytest.mark.parametrize("arguments", OTHERS, ids=lambda arguments: arguments[0])
@pytest.mark.slow
def test_other_work(forks, tmp_path, arguments):
    given = [tmp_path / "out" if one == "OUT" else one for one in arguments]
    assert interrupted(forks, tmp_path, given, 2, "LanguageWorldEnv", "_step") == [(130, 0)] * 2
