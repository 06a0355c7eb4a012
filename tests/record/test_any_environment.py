"""Recordings of other environments: objects, pictures, rewards, and recorders."""

import numpy as np
import pytest
import torch
from recordings import Recording
from tensordict import TensorDict
from torchrl.envs import Compose, PendulumEnv, SerialEnv, StepCounter, TransformedEnv

import lw_torchrl as lw
from lw_torchrl.record import RolloutRecorder
from lw_torchrl.record.tabs import Tabs


def tip_of(rollout):
    """Return the tip of a pendulum that swings in the plane y = 0, T×3."""
    angle = rollout["th"]
    return torch.stack((angle.sin(), torch.zeros_like(angle), angle.cos()), -1)


def test_objects_are_drawn_without_a_robot(tmp_path):
    torch.manual_seed(0)
    rollout = PendulumEnv().rollout(20)
    with lw.RerunLogger(tmp_path / "a.rrd") as logger:
        name = logger.log_episode(rollout, task="swing", objects={"tip": tip_of(rollout)}, step_time=0.05)
    recording = Recording(tmp_path / "a.rrd")
    assert name == "swing"
    shown = recording.array("/swing/scene/objects/tip", "Points3D:positions")[:, 0]
    np.testing.assert_allclose(shown, tip_of(rollout)[: len(shown)], atol=1e-6)
    for name, key in (("action", "action"), ("reward", ("next", "reward"))):
        np.testing.assert_array_equal(recording.array(f"/swing/{name}", "Scalars:scalars"), rollout[key].double())
    assert int(recording.times("/swing/action", "Scalars:scalars", "time")[1]) == 50_000_000
    assert not any("gripper" in entity or "table" in entity for entity in recording.entities())
    (place, target) = Tabs.read(recording.reader).pages["swing"].eye
    assert max(map(abs, target)) < 1.5
    assert 0.5 < np.linalg.norm(np.subtract(place, target)) < 5, "the camera sees everything"


def test_a_rollout_may_have_only_pictures_and_rewards(tmp_path):
    pictures = (torch.arange(5, dtype=torch.uint8) * 40)[:, None, None, None].expand(5, 3, 16, 24)
    columns = {"pixels": pictures, "action": torch.arange(5), ("next", "reward"): torch.arange(5.0)[:, None]}
    with lw.RerunLogger(tmp_path / "a.rrd") as logger:
        logger.log_episode(TensorDict(columns, [5]), task="game")
    recording = Recording(tmp_path / "a.rrd")
    assert recording.times("/game/seen", "EncodedImage:blob") == [0, 1, 2, 3, 4]
    assert recording.values("/game/action", "Scalars:scalars") == [[0.0], [1.0], [2.0], [3.0], [4.0]]
    assert not Tabs.read(recording.reader).pages["game"].has_scene


@pytest.mark.parametrize(
    ("make", "names"),
    [
        (PendulumEnv, ["swing-0", "swing-1"]),
        (lambda: SerialEnv(2, PendulumEnv), ["swing-0, row 1", "swing-0, row 0", "swing-1, row 1", "swing-1, row 0"]),
    ],
)
def test_recorder_records_other_environments(tmp_path, make, names):
    rows = (0,) if make is PendulumEnv else (1, 0)
    with lw.RerunLogger(tmp_path / "a.rrd") as logger:
        recorder = RolloutRecorder(logger, rows, objects=lambda rollout: {"tip": tip_of(rollout)}, task="swing")
        env = TransformedEnv(make(), Compose(StepCounter(max_steps=4), recorder))
        first, _ = (env.rollout(6) for _ in range(2))
        env.reset()
        env.close()
        assert logger.episodes == names
    recording, first = Recording(tmp_path / "a.rrd"), first if len(rows) == 1 else first[1]
    root = "/" + names[0].replace(",", "\\,").replace(" ", "\\ ")
    np.testing.assert_array_equal(recording.array(f"{root}/action", "Scalars:scalars"), first["action"].double())
    shown = recording.array(f"{root}/scene/objects/tip", "Points3D:positions")[:, 0]
    np.testing.assert_allclose(shown, tip_of(first), atol=1e-6)
