"""Ctrl-C ends training between two steps with a checkpoint."""

import random
import signal
import threading
import time
from itertools import pairwise

import pytest
from small_training import assert_same, everything, make_trainer
from torchrl.envs import Transform

import lw_torchrl as lw

CONFIG = lw.BehavioralCloningConfig(steps=40, batch_size=20, checkpoint_every=30)


class PressCtrlC(Transform):
    """Sends SIGINT while the sixth minibatch is drawn, once or several times."""

    def __init__(self, times=1):
        super().__init__()
        self.minibatches, self.presses = iter(range(1, 100)), iter(range(times))

    def forward(self, tensordict):
        if next(self.minibatches) == 6:
            for _ in self.presses:
                signal.raise_signal(signal.SIGINT)
        return tensordict


def make(demos, checkpoint, *, times=0):
    trainer = make_trainer(demos, checkpoint, config=CONFIG)
    trainer.replay.append_transform(PressCtrlC(times))
    return trainer


def test_training_ends_after_the_step_and_resumes_bit_for_bit(demos, tmp_path):
    handler = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        make(demos, tmp_path / "c.safetensors", times=1).train()
    assert signal.getsignal(signal.SIGINT) is handler
    resumed = make(demos, tmp_path / "c.safetensors")
    assert resumed.steps == 6
    resumed.train()
    whole = make(demos, None)
    whole.train()
    assert_same(everything(resumed), everything(whole))


def test_a_second_ctrl_c_ends_training_at_once(demos, tmp_path):
    trainer = make(demos, tmp_path / "c.safetensors", times=2)
    handler = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        trainer.train()
    assert signal.getsignal(signal.SIGINT) is handler
    assert trainer.steps == 5
    assert not (tmp_path / "c.safetensors").exists()


def test_an_ignored_sigint_stays_ignored(demos, tmp_path):
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        trainer = make(demos, tmp_path / "c.safetensors", times=1)
        trainer.train()
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)
    assert trainer.steps == CONFIG.steps


def test_training_in_another_thread_changes_no_signal_handler(demos):
    trainer = make(demos, None)
    thread = threading.Thread(target=trainer.train)
    thread.start()
    thread.join()
    assert trainer.steps == CONFIG.steps


# Runs in a command before its work: writes to a file when the work begins, and at which step.
RECORD_START = """
import lw_torchrl as lw

owner, method, begun = getattr(lw, {owner!r}), {method!r}, {begun!r}
original = getattr(owner, method)

def record(self, *args):
    setattr(owner, method, original)
    with open(begun, "w") as file:
        file.write(f"{{getattr(self, 'steps', 0)}}\\n")
    return original(self, *args)

setattr(owner, method, record)
"""


def interrupted(forks, tmp_path, arguments, runs, owner, method):
    """Interrupt each run at a random moment; return its exit status and the step at which it began."""
    begun, chance, results = tmp_path / "begun", random.Random(0), []
    for _ in range(runs):
        begun.write_text("")
        forks.start(*arguments, before=RECORD_START.format(owner=owner, method=method, begun=str(begun)))
        while not begun.read_text().endswith("\n"):
            assert forks.running(0.005), forks.end()
        time.sleep(chance.uniform(0, 0.15))
        forks.send(signal.SIGINT)
        ended = forks.end()
        assert "Traceback" not in ended.err
        results.append((ended.status, int(begun.read_text())))
    return results


@pytest.mark.slow
def test_runs_that_are_interrupted_at_random_moments_lose_no_step(forks, demos, tmp_path):
    file = tmp_path / "policy.safetensors"
    arguments = ["train", demos, "--out", file, "--steps", 10**6, "--batch-size", 20, "--width", 16, "--depth", 1]
    results = interrupted(forks, tmp_path, arguments, 20, "BehavioralCloningTrainer", "step")
    assert [status for status, _ in results] == [130] * 20
    steps = [step for _, step in results]
    assert steps[0] == 0
    assert all(before < after for before, after in pairwise(steps)), steps


OTHERS = (
    ("collect", "reach", "push", "--out", "OUT"),
    ("evaluate", "expert", "--tasks", "reach"),
    ("demo", "--quick", "--out", "OUT"),
)


@pytest.mark.parametrize("arguments", OTHERS, ids=lambda arguments: arguments[0])
@pytest.mark.slow
def test_other_commands_end_with_status_130(forks, tmp_path, arguments):
    arguments = [tmp_path / "out" if argument == "OUT" else argument for argument in arguments]
    assert interrupted(forks, tmp_path, arguments, 2, "LanguageWorldEnv", "_step") == [(130, 0)] * 2
