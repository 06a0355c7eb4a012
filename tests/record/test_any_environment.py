"""Rollouts of environments that are not ours are recorded: with positions of objects, and without anything."""

from __future__ import annotations

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
    """The tip of a pendulum that swings in the plane y = 0, T×3."""
    angle = rollout["th"]
    return torch.stack((angle.sin(), torch.zeros_like(angle), angle.cos()), -1)


def test_positions_alone_are_drawn(tmp_path):
    rollout = PendulumEnv().rollout(20)
    with lw.RerunLogger(tmp_path / "a.rrd") as logger:
        name = logger.log_episode(rollout, task="swing", objects={"tip": tip_of(rollout)}, step_time=0.05)
    found = Recording(tmp_path / "a.rrd")
    assert name == "swing"
    shown = found.array("/swing/scene/objects/tip", "Points3D:positions")[:, 0]
    np.testing.assert_allclose(shown, tip_of(rollout)[: len(shown)], atol=1e-6)
    np.testing.assert_array_equal(found.array("/swing/action", "Scalars:scalars"), rollout["action"].double())
    np.testing.assert_array_equal(found.array("/swing/reward", "Scalars:scalars"), rollout["next", "reward"].double())
    assert int(found.times("/swing/action", "Scalars:scalars", "time")[1]) == 50_000_000
    assert not any("gripper" in entity or "table" in entity for entity in found.entities()), "no hand, no table"
    (place, target) = Tabs.read(found.reader).pages["swing"].eye
    assert max(map(abs, target)) < 1.5
    assert 0.5 < np.linalg.norm(np.subtract(place, target)) < 5, "all of it is seen"


def test_an_observation_of_another_size_needs_no_layout(tmp_path):
    rollout = PendulumEnv().rollout(20)
    rollout["observation"] = tip_of(rollout)
    with lw.RerunLogger(tmp_path / "a.rrd") as logger:
        assert logger.log_episode(rollout, task="swing", objects={"tip": tip_of(rollout)}) == "swing"
        with pytest.raises(ValueError, match=r"'observation'\] must have shape 20×39, got 20×3"):
            logger.log_episode(rollout, task="push", objects={"tip": tip_of(rollout)})
        with pytest.raises(ValueError, match=r"objects\['tip'\] must have shape 20×3, got 19×3"):
            logger.log_episode(rollout, task="swing", objects={"tip": tip_of(rollout)[1:]})


def test_a_rollout_of_nothing_but_pictures_and_rewards(tmp_path):
    pictures = (torch.arange(5, dtype=torch.uint8) * 40)[:, None, None, None].expand(5, 3, 16, 24)
    columns = {"pixels": pictures, "action": torch.arange(5), ("next", "reward"): torch.arange(5.0)[:, None]}
    with lw.RerunLogger(tmp_path / "a.rrd") as logger:
        logger.log_episode(TensorDict(columns, [5]), task="game")
    found = Recording(tmp_path / "a.rrd")
    assert found.times("/game/seen", "EncodedImage:blob") == [0, 1, 2, 3, 4]
    assert found.values("/game/action", "Scalars:scalars") == [[0.0], [1.0], [2.0], [3.0], [4.0]]
    assert not Tabs.read(found.reader).pages["game"].has_scene


@pytest.mark.parametrize("make", [PendulumEnv, lambda: SerialEnv(2, PendulumEnv)])
def test_a_recorder_on_another_environment(tmp_path, make):
    rows = (0,) if make is PendulumEnv else (1, 0)
    with lw.RerunLogger(tmp_path / "a.rrd") as logger:
        recorder = RolloutRecorder(logger, rows, objects=lambda rollout: {"tip": tip_of(rollout)}, task="swing")
        env = TransformedEnv(make(), Compose(StepCounter(max_steps=4), recorder))
        rollouts = [env.rollout(6) for _ in range(2)]
        env.reset()
        env.close()
        names = ["swing-0", "swing-1"] if len(rows) == 1 else ["swing-0, row 1", "swing-0, row 0"]
        assert logger.episodes[:2] == names
        assert len(logger.episodes) == 2 * len(rows)
    found = Recording(tmp_path / "a.rrd")
    first = rollouts[0] if len(rows) == 1 else rollouts[0][1]
    root = "/swing-0" if len(rows) == 1 else "/swing-0\\,\\ row\\ 1"
    np.testing.assert_array_equal(found.array(f"{root}/action", "Scalars:scalars"), first["action"].double())
    shown = found.array(f"{root}/scene/objects/tip", "Points3D:positions")[:, 0]
    np.testing.assert_allclose(shown, tip_of(first), atol=1e-6)


def test_a_recorder_without_a_task_or_objects_uses_the_class_name(tmp_path):
    with lw.RerunLogger(tmp_path / "a.rrd") as logger:
        env = TransformedEnv(PendulumEnv(), RolloutRecorder(logger))
        env.rollout(3)
        env.close()
        assert logger.episodes == ["PendulumEnv-0"], "an episode that closing cuts is kept as far as it went"
    assert len(Recording(tmp_path / "a.rrd").values("/PendulumEnv-0/action", "Scalars:scalars")) == 3
