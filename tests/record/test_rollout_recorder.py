"""RolloutRecorder: recordings equal those that log_rollout makes afterwards, and show other environments too."""

import numpy as np
import pytest
import torch
from recordings import Recording
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import Compose, PendulumEnv, SerialEnv, StepCounter, TransformedEnv

import lw_torchrl as lw
from lw_torchrl.record import RolloutRecorder
from lw_torchrl.record.tabs import Tabs

PLANS = lw.load_plans("MT10")


def make(logger, tasks=("push", "reach"), *, rows=(0,), num_envs=2, length=8, **options):
    recorder = RolloutRecorder(logger, rows, plans=PLANS, **options)
    base = lw.LanguageWorldEnv(tasks, num_envs=num_envs, seed=5, num_threads=1, max_steps=length)
    return TransformedEnv(base, Compose(lw.QAFTransform(PLANS), recorder))


def content(path):
    """Return all columns with their times, except names that begin with the recording's id."""
    recording = Recording(path)
    keys = [key for key in recording.columns if not key[0].startswith("/__") and key[1] != "Transform3D:child_frame"]
    times = {key: None if recording.is_static(*key) else recording.times(*key) for key in keys}
    return {key: (times[key], recording.values(*key)) for key in keys}


def test_live_recording_equals_one_made_afterwards(tmp_path):
    live = lw.RerunLogger(tmp_path / "live.rrd")
    env = make(live, num_envs=3, rows=(1, 2), policy="scripted")
    rollout = env.rollout(8, lw.ScriptedSkillActor(PLANS))
    env.close()
    live.shutdown()
    with lw.RerunLogger(tmp_path / "later.rrd") as later:
        names = lw.log_rollout(later, rollout[1:], PLANS, seed=5, policy="scripted")
    assert live.episodes == names == ["reach-0", "push-1"]
    first, second = content(tmp_path / "live.rrd"), content(tmp_path / "later.rrd")
    # Contacts are only computed when an episode is simulated again.
    second = {(entity, part): value for (entity, part), value in second.items() if "touches" not in entity}
    assert first.keys() == second.keys()
    assert any("/bodies" in entity for entity, _ in first)
    for key, value in first.items():
        assert str(value) == str(second[key]), key


def test_every_nth_episode_with_a_step_is_recorded(tmp_path):
    with lw.RerunLogger(tmp_path / "a.rrd") as logger:
        env = make(logger, ["reach"], num_envs=1, length=3, every=2)
        env.reset()
        for _ in range(4):
            env.rollout(3)
        env.close()
        assert logger.episodes == ["reach-1", "reach-3"]


def test_rows_that_are_reset_or_stepped_alone_are_recorded(tmp_path):
    with lw.RerunLogger(tmp_path / "a.rrd") as logger:
        env = make(logger, rows=(0, 1))
        state = env.reset()
        for _ in range(2):
            state = env.step_mdp(env.step(env.rand_action(state)))
        state["_step"] = torch.tensor([False, True])
        state = env.step_mdp(env.step(env.rand_action(state)))
        state["_reset"] = torch.tensor([[True], [False]])
        state = env.reset(state).exclude("_reset", "_step")
        assert logger.episodes == ["push-0"]
        env.step(env.rand_action(state))
        env.close()
        env.transform.close()
        assert logger.episodes == ["push-0", "push-1", "reach-0"]
    recording = Recording(tmp_path / "a.rrd")
    lengths = [len(recording.values(f"/{name}/action", "Scalars:scalars")) for name in logger.episodes]
    assert lengths == [2, 1, 4]


def test_a_collector_records(tmp_path):
    with lw.RerunLogger(tmp_path / "a.rrd") as logger:
        frames = {"frames_per_batch": 16, "total_frames": 32, "auto_register_policy_transforms": False}
        collector = Collector(make(logger, length=5), lw.ScriptedSkillActor(PLANS), **frames)
        list(collector)
        collector.shutdown()
        # 16 steps of each row: three episodes and one step.
        assert logger.episodes == ["push-0", "push-1", "push-2", "push-3"]


def test_a_clone_records_its_own_rows(tmp_path):
    with lw.RerunLogger(tmp_path / "a.rrd") as logger:
        env = make(logger, ["reach"], num_envs=1)
        state = env.reset()
        env.step(env.rand_action(state))
        other = TransformedEnv(lw.LanguageWorldEnv("reach", seed=6), env.transform[1].clone())
        other.close()
        assert logger.episodes == []
        env.close()
        assert logger.episodes == ["reach-0"]


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


@pytest.mark.parametrize("rows", [(0,), (1, 0)])
def test_recorder_records_other_environments(tmp_path, rows):
    base = PendulumEnv() if rows == (0,) else SerialEnv(2, PendulumEnv)
    names = [f"swing-{each}" + f", row {row}" * (rows != (0,)) for each in range(2) for row in rows]
    with lw.RerunLogger(tmp_path / "a.rrd") as logger:
        recorder = RolloutRecorder(logger, rows, objects=lambda rollout: {"tip": tip_of(rollout)}, task="swing")
        env = TransformedEnv(base, Compose(StepCounter(max_steps=4), recorder))
        first, _ = (env.rollout(6) for _ in range(2))
        env.reset()
        env.close()
        assert logger.episodes == names
    recording, first = Recording(tmp_path / "a.rrd"), first if len(rows) == 1 else first[1]
    root = "/" + names[0].replace(",", "\\,").replace(" ", "\\ ")
    np.testing.assert_array_equal(recording.array(f"{root}/action", "Scalars:scalars"), first["action"].double())
    shown = recording.array(f"{root}/scene/objects/tip", "Points3D:positions")[:, 0]
    np.testing.assert_allclose(shown, tip_of(first), atol=1e-6)
