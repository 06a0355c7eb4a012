"""Training that is interrupted or killed anywhere, also by Ctrl-C, resumes from its checkpoint bit for bit."""

import math
import random
import signal
import subprocess
import sys
import textwrap
import threading
import time
from dataclasses import replace
from itertools import pairwise
from unittest.mock import Mock, patch

import pytest
import torch
from small_training import CONFIG, assert_same, everything, flat, make_actor, make_trainer
from torchrl.data import RandomSampler, SamplerWithoutReplacement
from torchrl.envs import Transform

import lw_torchrl as lw


@pytest.mark.parametrize("stops", [[5], [6, 6], [3, 8, 11]])
def test_training_interrupted_at_any_step_resumes_bit_for_bit(demos, uninterrupted, tmp_path, stops):
    path = tmp_path / "runs" / "checkpoint.safetensors"
    for stop in stops:
        with pytest.raises(KeyboardInterrupt):
            make_trainer(demos, path, stop_at=stop).train()
    resumed = make_trainer(demos, path, actor=make_actor(99))
    assert resumed.steps == max(stops) // 5 * 5
    resumed.train()
    assert_same(everything(resumed), uninterrupted)


def test_a_transforms_random_numbers_depend_on_the_seed_and_resume(demos, tmp_path):
    def trainer(noise, checkpoint=None, stop_at=None):
        trainer = make_trainer(demos, checkpoint, stop_at=stop_at)
        trainer.replay.append_transform(lw.RandomYaw(0.5))
        torch.manual_seed(noise)  # other random numbers of this process must not matter
        return trainer

    whole = trainer(1)
    whole.train()
    with pytest.raises(KeyboardInterrupt):
        trainer(2, tmp_path / "c.safetensors", stop_at=7).train()
    resumed = trainer(3, tmp_path / "c.safetensors")
    resumed.train()
    assert_same(flat(resumed.actor.state_dict()), flat(whole.actor.state_dict()))
    plain = make_trainer(demos)
    plain.train()
    assert not torch.equal(plain.actor.decoder.network[0].weight, whole.actor.decoder.network[0].weight)


@pytest.mark.parametrize("sampler", [RandomSampler, SamplerWithoutReplacement])
def test_torchrls_samplers_and_an_integer_learning_rate_resume(demos, tmp_path, sampler):
    path, config = tmp_path / "checkpoint.safetensors", replace(CONFIG, learning_rate=1)
    whole = make_trainer(demos, sampler=sampler(), config=config)
    whole.train()
    with pytest.raises(KeyboardInterrupt):
        make_trainer(demos, path, sampler=sampler(), config=config, stop_at=8).train()
    resumed = make_trainer(demos, path, actor=make_actor(99), sampler=sampler(), config=config)
    assert resumed.steps == 5
    resumed.train()
    assert_same(everything(resumed), everything(whole))


def test_a_kill_between_training_state_and_policy_is_repaired(demos, tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    make_trainer(demos, path).train(until=5)
    older = path.read_bytes()
    make_trainer(demos, path).train()
    newer = path.read_bytes()
    path.write_bytes(older)
    make_trainer(demos, path).train()
    assert path.read_bytes() == newer != older


def test_checkpoints_are_written_on_schedule_as_two_files(demos, tmp_path, monkeypatch):
    saved = []
    save = lw.BehavioralCloningTrainer.save
    monkeypatch.setattr(lw.BehavioralCloningTrainer, "save", lambda self: (saved.append(self.steps), save(self)))
    make_trainer(demos, tmp_path / "checkpoint.safetensors").train()
    assert saved == [5, 10, 12]
    assert {path.name for path in tmp_path.iterdir()} == {"checkpoint.safetensors", "checkpoint.training.safetensors"}


def test_training_in_parts_equals_training_at_once_and_a_finished_one_changes_nothing(demos, uninterrupted, tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    trainer = make_trainer(demos, path)
    trainer.train(until=4)
    assert (trainer.steps, trainer.actor.training) == (4, False)
    assert make_trainer(demos, path).steps == 4
    assert math.isnan(trainer.train(until=3))
    trainer.train(until=7)
    trainer.train()
    content, finished = path.read_bytes(), make_trainer(demos, path, actor=make_actor(99), stop_at=CONFIG.steps)
    assert math.isnan(finished.train())
    assert path.read_bytes() == content
    for trained in (trainer, finished):
        assert_same(everything(trained), uninterrupted)
    for until in (0, 13):
        with pytest.raises(ValueError, match="until"):
            trainer.train(until=until)


@pytest.mark.parametrize("with_checkpoint", [True, False])
def test_weights_that_the_last_step_makes_infinite_are_not_saved(demos, tmp_path, with_checkpoint):
    """No loss is computed after the last step, so the weights themselves are checked."""
    path = tmp_path / "checkpoint.safetensors" if with_checkpoint else None
    config = replace(CONFIG, steps=1, optimizer="sgd", learning_rate=1e30, weight_decay=1e10)
    with pytest.raises(ValueError, match=r"weights: .* is NaN or infinite after step 1; try a lower learning rate"):
        make_trainer(demos, path, config=config).train()
    assert not list(tmp_path.iterdir())


KILLER = """
    import os, random, signal, sys, time
    import torch
    import lw_torchrl as lw

    (root, path), plans = sys.argv[1:], lw.load_plans("MT10")
    config = lw.BehavioralCloningConfig(steps=40, batch_size=8, checkpoint_every=1)

    def train(path, seed):
        torch.manual_seed(seed)
        actor = lw.PlanConditionedActor(plans, decoder=lw.modules.MLPDecoder(width=16, depth=1))
        parts = {"sampler": lw.TaskBalancedSampler(), "transform": lw.QAFTransform(plans)}
        replay = lw.LanguageWorldExperienceReplay(root, **parts)
        trainer = lw.BehavioralCloningTrainer(actor, replay, config, checkpoint=path, progress=False)
        trainer.train()
        return {**actor.state_dict(), "batch": replay.sample(8)["observation"]}

    draw, kills, seed = random.Random(0), 0, 0
    for _ in range(12):
        child = os.fork()
        if child == 0:
            try:
                train(path, seed)
            except BaseException as error:
                print(repr(error), file=sys.stderr)
                os._exit(1)
            os._exit(0)
        time.sleep(draw.uniform(0.02, 0.3))
        os.kill(child, signal.SIGKILL)
        status = os.waitpid(child, 0)[1]
        assert not os.WIFEXITED(status) or os.WEXITSTATUS(status) == 0
        kills += os.WIFSIGNALED(status)
        if os.path.exists(path):
            lw.load_actor(path)
            seed = 99
    resumed, whole = train(path, seed), train(None, 0)
    assert all(torch.equal(resumed[key], whole[key]) for key in whole)
    print(kills)
"""


@pytest.mark.slow
def test_a_kill_at_any_moment_leaves_a_whole_checkpoint_that_resumes_bit_for_bit(demos, tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    command = [sys.executable, "-W", "ignore", "-c", textwrap.dedent(KILLER), str(demos), str(path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) >= 3


@pytest.mark.parametrize("failing", ["pathlib.Path.write_bytes", "os.replace"])
def test_a_full_disk_leaves_the_old_checkpoint(demos, tmp_path, failing):
    path = tmp_path / "checkpoint.safetensors"
    with pytest.raises(KeyboardInterrupt):
        make_trainer(demos, path, stop_at=6).train()
    files = {file: file.read_bytes() for file in tmp_path.iterdir()}
    resumed, full = make_trainer(demos, path), Mock(side_effect=OSError(28, "No space left on device"))
    with patch(failing, full), pytest.raises(OSError, match="No space left"):
        resumed.save()
    assert {file: file.read_bytes() for file in tmp_path.iterdir()} == files
    assert make_trainer(demos, path).steps == 5


LONGER = lw.BehavioralCloningConfig(steps=40, batch_size=20, checkpoint_every=30)


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
    trainer = make_trainer(demos, checkpoint, config=LONGER)
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
    assert (signal.getsignal(signal.SIGINT), trainer.steps) == (handler, 5)
    assert not (tmp_path / "c.safetensors").exists()


def test_an_ignored_sigint_stays_ignored_and_a_thread_changes_no_signal_handler(demos):
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        trainer = make(demos, None, times=1)
        trainer.train()
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)
    other = make(demos, None)
    thread = threading.Thread(target=other.train)
    thread.start()
    thread.join()
    assert trainer.steps == other.steps == LONGER.steps


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


@pytest.mark.parametrize(
    "command", ["collect reach --out {}", "evaluate expert --tasks reach", "demo --quick --out {}"]
)
@pytest.mark.slow
def test_other_commands_end_with_status_130(forks, tmp_path, command):
    arguments = [part.format(tmp_path / "out") for part in command.split()]
    assert interrupted(forks, tmp_path, arguments, 2, "LanguageWorldEnv", "_step") == [(130, 0)] * 2
