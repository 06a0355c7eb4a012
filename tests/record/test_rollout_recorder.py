"""RolloutRecorder: a live recording equals the one that log_rollout makes of the rollout afterwards."""

import torch
from recordings import Recording
from torchrl.collectors import Collector
from torchrl.envs import Compose, TransformedEnv

import lw_torchrl as lw
from lw_torchrl.record import RolloutRecorder

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
