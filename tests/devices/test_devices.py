"""Devices: names, a GPU if there is one, and a pretend device that records every wait, in another process."""

import os
import sys
from pathlib import Path

import pytest
import torch
from commands import python_process
from torchrl.envs import TransformedEnv

import lw_torchrl as lw
from lw_torchrl._util.devices import CPU, check_device, device_of
from lw_torchrl.cli.main import main

HERE = Path(__file__).parent
PLANS = lw.load_plans("MT10")
needs_a_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
needs_no_gpu = pytest.mark.skipif(torch.accelerator.is_available(), reason="needs a machine without a GPU")


@pytest.mark.slow
def test_pretend_device_is_never_waited_for():
    paths = [str(HERE), *(str(HERE.parent / room) for room in ("training", "objectives")), *sys.path]
    words = ["-m", "pytest", "-q", "-p", "no:cacheprovider", HERE / "on_a_pretend_device.py"]
    variables = {"PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
    done = python_process(*words, cwd=HERE.parent.parent, **variables)
    assert done.returncode == 0, done.stdout[-8000:] + done.stderr[-2000:]
    assert " passed" in done.stdout


def test_cpu_is_available():
    assert check_device("device", "cpu") == check_device("device", CPU) == device_of(torch.nn.Module()) == CPU
    assert torch.accelerator.is_available() or check_device("device", "auto") == CPU


@needs_no_gpu
@pytest.mark.parametrize("device", ["cuda", "gpu"])
def test_command_line_names_a_wrong_device_before_any_work(demos, tmp_path, monkeypatch, capsys, device):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as caught:
        main(["train", str(demos), "--out", "p.safetensors", "--device", device])
    assert caught.value.code == 2
    assert "device must be 'cpu', 'auto' or a device of this machine" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    root = tmp_path_factory.mktemp("demos") / "d"
    lw.collect_demonstrations("reach", episodes_per_task=1, root=root, max_steps=30, progress=False)
    return root


def make_replay(demos, device=None):
    transform = lw.QAFTransform(PLANS)
    return lw.LanguageWorldExperienceReplay(demos, sampler=lw.TaskBalancedSampler(), transform=transform, device=device)


@pytest.mark.filterwarnings("ignore:Synchronization debug mode")
@needs_a_gpu
def test_gpu_is_never_waited_for(demos, tmp_path):
    """CUDA itself reports waits. Draws equal the CPU's, and sums nearly so."""
    config = lw.BehavioralCloningConfig(steps=8, batch_size=10)
    losses = {}
    for device in ("cpu", "cuda"):
        torch.manual_seed(0)
        actor = lw.PlanConditionedActor(PLANS, features=lw.modules.ObservationFeatures())
        options = {"checkpoint": tmp_path / f"{device}.safetensors", "progress": False, "device": device}
        trainer = lw.BehavioralCloningTrainer(actor, make_replay(demos, device), config, **options)
        losses[device] = [trainer.step().item() for _ in range(4)]
        torch.cuda.set_sync_debug_mode("error" if device == "cuda" else "default")
        try:
            for _ in range(3):
                trainer.step()
        finally:
            torch.cuda.set_sync_debug_mode("default")
        trainer.train()
    assert losses["cuda"] == pytest.approx(losses["cpu"], rel=1e-3)
    options = {"tasks": "reach", "episodes_per_task": 2, "seed": 1000, "max_steps": 20, "progress": False}
    on_gpu = lw.evaluate(actor, record_actions=True, **options)
    on_cpu = lw.evaluate(lw.load_actor(tmp_path / "cuda.safetensors"), record_actions=True, **options)
    for episode, other in zip(on_gpu.episodes, on_cpu.episodes, strict=True):
        assert (episode.actions - other.actions).abs().max() < 1e-2


@needs_a_gpu
def test_gpu_steps_are_captured_and_resume_bit_for_bit(demos, tmp_path):
    config = lw.BehavioralCloningConfig(steps=16, batch_size=10)

    def train(path=None, until=None, capture=None):
        torch.manual_seed(0)
        replay = make_replay(demos, "cuda")
        replay.append_transform(lw.RandomYaw(0.3, plans=PLANS))
        actor = lw.PlanConditionedActor(PLANS, features=lw.modules.ObservationFeatures(noise=0.1))
        options = {"checkpoint": path, "progress": False, "device": "cuda", "capture": capture}
        trainer = lw.BehavioralCloningTrainer(actor, replay, config, **options)
        trainer.train(until=until)
        assert trainer._captured.is_captured is (capture is not False)
        return dict(actor.cpu().named_parameters())

    whole = train()
    train(tmp_path / "p.safetensors", until=8)
    for other in (train(tmp_path / "p.safetensors"), train(capture=False)):
        assert all(torch.equal(value, whole[name]) for name, value in other.items())


@needs_a_gpu
def test_gpu_environment_equals_the_cpus():
    observations = []
    for device in ("cuda", "cpu"):
        env = TransformedEnv(lw.LanguageWorldEnv(["push", "reach"], max_steps=9, device=device), lw.QAFTransform(PLANS))
        rollout = env.rollout(12, lw.ScriptedSkillActor(PLANS).to(device), break_when_any_done=False)
        assert {value.device.type for value in rollout.values(True, True)} == {device}
        observations.append(rollout["next", "observation"].cpu())
        env.close()
    torch.testing.assert_close(*observations, atol=1e-4, rtol=0.0)
