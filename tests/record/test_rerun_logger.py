"""RerunLogger: what is logged can be read back exactly, and the file is there whole or not at all."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from rerun.chunk import RrdReader
from tensordict import TensorDict
from torchrl.record import VideoRecorder
from torchrl.record.loggers import Logger

from lw_torchrl.record import RerunLogger
from lw_torchrl.record.blueprint import EVENLY, active_skill
from lw_torchrl.record.scene import GRIPPER

STEPS = (
    ("the robot's gripper is not near the puck", "place the gripper above the puck"),
    ("the robot's gripper is near the puck", "close the gripper around the puck"),
)
PLAN = SimpleNamespace(steps=[SimpleNamespace(condition=c, skill=s) for c, s in STEPS])


def make_rollout(length=20, columns=3, seed=0):
    """Random numbers in the shapes of design.md; the columns beyond the plan's two steps are padding."""
    generator = torch.Generator().manual_seed(seed)
    qaf = torch.rand(length, columns, generator=generator) > 0.5
    qaf[:, len(STEPS) :] = False
    skill_weights = torch.zeros(length, columns)
    skill_weights[:, : len(STEPS)] = torch.softmax(qaf[:, : len(STEPS)] * 10.0 - 5.0, -1)
    return TensorDict(
        {
            "observation": torch.rand(length, 39, generator=generator),
            "action": torch.rand(length, 4, generator=generator) * 2 - 1,
            "qaf": qaf,
            "skill_weights": skill_weights,
            ("next", "success"): torch.arange(length)[:, None] >= length // 2,
            ("next", "reward"): torch.rand(length, 1, generator=generator),
        },
        [length],
    )


def make_objects(rollout):
    observation = rollout["observation"]
    return {GRIPPER: observation[:, :3], "puck": observation[:, 4:7]}


def record(path, *rollouts, **kwargs):
    with RerunLogger(path) as logger:
        for rollout in rollouts:
            logger.log_episode(rollout, **{"task": "push", "objects": make_objects(rollout), "plan": PLAN} | kwargs)
    return Recording(path)


class Recording:
    """The columns of a recording, by entity and component."""

    def __init__(self, path):
        self.reader = RrdReader(path)
        self.columns = {}
        for chunk in self.reader.stream():
            batch = chunk.to_record_batch()
            times = {name: batch.column(name).to_numpy(zero_copy_only=False) for name in chunk.timeline_names}
            for name in batch.schema.names:
                if ":" in name:
                    entry = (times, batch.column(name).to_pylist())
                    self.columns.setdefault((chunk.entity_path, name), []).append(entry)

    def entities(self):
        return {entity for entity, _ in self.columns}

    def values(self, entity, component):
        """One row for each time: a list of instances."""
        return [row for _, rows in self.columns[entity, component] for row in rows]

    def array(self, entity, component):
        return np.array(self.values(entity, component))

    def times(self, entity, component, timeline="step"):
        return np.concatenate([times[timeline] for times, _ in self.columns[entity, component]]).tolist()

    def text(self, entity):
        return self.values(entity, "TextDocument:text")[0][0]

    def lane(self, entity, length, first=0):
        """The state at each of ``length`` steps, unrolled from its changes."""
        steps = self.times(entity, "StateChange:state")
        states = [row[0] for row in self.values(entity, "StateChange:state")]
        assert (steps[-1], states[-1]) == (first + length, "")
        at = np.searchsorted(steps, np.arange(length) + first, side="right") - 1
        return [states[i] for i in at]


def test_an_episode_survives_exactly(tmp_path):
    rollout = make_rollout()
    found = record(tmp_path / "a.rrd", rollout)

    for name, position in make_objects(rollout).items():
        entity = "/push/scene/objects/" + name.replace("'", "\\'").replace(" ", "\\ ")
        np.testing.assert_array_equal(found.array(entity, "Points3D:positions")[:, 0], position.numpy())
    goal = found.array("/push/scene/goal", "Points3D:positions")[:, 0]
    np.testing.assert_array_equal(goal, rollout["observation"][:, 36:39].numpy())
    hand = found.array("/push/scene/gripper", "Transform3D:translation")[:, 0]
    np.testing.assert_array_equal(hand, rollout["observation"][:, :3].numpy())
    np.testing.assert_array_equal(found.array("/push/action", "Scalars:scalars"), rollout["action"].double())
    weights = found.array("/push/skill_weights", "Scalars:scalars")
    np.testing.assert_array_equal(weights, rollout["skill_weights"][:, :2].double())
    reward = found.array("/push/reward", "Scalars:scalars")
    np.testing.assert_array_equal(reward, rollout["next", "reward"].double())

    for i in range(2):
        expected = ["true" if held else "false" for held in rollout["qaf"][:, i]]
        assert found.lane(f"/push/lanes/condition-{i + 1}", 20) == expected
    assert found.lane("/push/lanes/success", 20, first=1) == ["false"] * 10 + ["true"] * 10
    assert "/push/lanes/condition-3" not in found.entities()


def test_texts_survive(tmp_path):
    rollout = make_rollout()
    found = record(tmp_path / "a.rrd", rollout)
    for i, (condition, skill) in enumerate(STEPS, 1):
        assert f"{i}. if **{condition}**:" in found.text("/push/plan")
        assert skill in found.text("/push/plan")
        labels = found.values(f"/push/lanes/condition-{i}", "StateConfiguration:labels")[0]
        assert labels == [f"✓ {condition}", f"✗ {condition}"]
    names = [f"{i} {skill}" for i, (_, skill) in enumerate(STEPS, 1)]
    assert found.values("/push/skill_weights", "SeriesLines:names") == [names]
    states = found.lane("/push/lanes/skill", 20)
    for row, state in enumerate(states):
        first, second = rollout["skill_weights"][row, :2]
        assert state == (EVENLY if first == second else names[int(second > first)])


def test_timelines(tmp_path):
    found = record(tmp_path / "a.rrd", make_rollout(5))
    assert found.times("/push/action", "Scalars:scalars") == [0, 1, 2, 3, 4]
    assert found.times("/push/reward", "Scalars:scalars") == [1, 2, 3, 4, 5]
    seconds = found.times("/push/action", "Scalars:scalars", "time")
    assert [int(second) for second in seconds] == [0, 12_500_000, 25_000_000, 37_500_000, 50_000_000]


def test_control_period_is_metaworlds():
    from lw_torchrl.envs.engines.metaworld import make_metaworld_env
    from lw_torchrl.record.scene import CONTROL_PERIOD

    env = make_metaworld_env("reach")
    period = env.frame_skip * env.model.opt.timestep
    assert period == pytest.approx(CONTROL_PERIOD)
    env.close()


def test_fingers_follow_the_opening(tmp_path):
    rollout = make_rollout(2)
    rollout["observation"][:, 3] = torch.tensor([0.0, 1.0])
    centers = record(tmp_path / "a.rrd", rollout).array("/push/scene/gripper/fingers", "Boxes3D:centers")
    apart = centers[:, 0, 1] - centers[:, 1, 1]
    assert apart[1] - apart[0] == pytest.approx(0.1)


def test_what_is_absent_is_left_out(tmp_path):
    rollout = make_rollout(5).select("observation", "action")
    rollout["observation"][:, 36:39] = 0.0
    found = record(tmp_path / "a.rrd", rollout, plan=None, objects={})
    roots = {entity.split("/")[2] for entity in found.entities() if entity.startswith("/push/")}
    assert roots == {"scene", "action"}
    assert not any("goal" in entity for entity in found.entities())
    gripper = found.array("/push/scene/objects/robot\\'s\\ gripper", "Points3D:positions")[:, 0]
    np.testing.assert_array_equal(gripper, rollout["observation"][:, :3].numpy())


def test_without_a_plan_every_column_is_numbered(tmp_path):
    found = record(tmp_path / "a.rrd", make_rollout(5), plan=None)
    assert found.values("/push/skill_weights", "SeriesLines:names") == [["1", "2", "3"]]
    assert "/push/lanes/condition-3" in found.entities()


def test_a_goal_that_is_an_object_has_one_label(tmp_path):
    rollout = make_rollout(5)
    objects = {"target location": rollout["observation"][:, 36:39]}
    found = record(tmp_path / "a.rrd", rollout, objects=objects)
    assert "/push/scene/goal" in found.entities()
    assert "/push/scene/goal/foot" not in found.entities()


def test_active_skill():
    weights = np.array([[0.9, 0.1], [0.5, 0.5], [0.2, 0.8]], np.float32)
    assert active_skill(weights, ["a", "b"]) == ["a", EVENLY, "b"]
    assert active_skill(np.ones((1, 1), np.float32), ["only"]) == ["only"]


def test_several_episodes_and_their_names(tmp_path):
    first, second = make_rollout(5, seed=1), make_rollout(7, seed=2)
    with RerunLogger(tmp_path / "a.rrd") as logger:
        names = [
            logger.log_episode(rollout, task="push", objects=make_objects(rollout), name=name)
            for rollout, name in ((first, None), (second, None), (first, "best so far"))
        ]
        with pytest.raises(ValueError, match="name must be another"):
            logger.log_episode(first, task="push", objects={}, name="push 2")
        with pytest.raises(ValueError, match="name must be another"):
            logger.log_episode(first, task="push", objects={}, name="metrics")
    assert names == ["push", "push 2", "best so far"]
    found = Recording(tmp_path / "a.rrd")
    for root, rollout in (("/push", first), ("/push\\ 2", second), ("/best\\ so\\ far", first)):
        np.testing.assert_array_equal(found.array(f"{root}/action", "Scalars:scalars"), rollout["action"].double())


def test_the_layout_is_in_the_file(tmp_path):
    found = record(tmp_path / "a.rrd", make_rollout())
    (store,) = found.reader.blueprints()
    chunks = found.reader.stream(store=store)
    text = " ".join(f"{chunk.entity_path} {chunk.to_record_batch()}" for chunk in chunks)
    for expected in ("Scene", "Plan", "Skill weights", "Action", "/push/scene/trails/puck"):
        assert expected in text


def test_speed(tmp_path):
    rollout = make_rollout(500, columns=8)
    objects = make_objects(rollout)
    with RerunLogger(tmp_path / "a.rrd") as logger:
        logger.log_episode(rollout, task="push", objects=objects, plan=PLAN)
        start = time.perf_counter()
        logger.log_episode(rollout, task="push", objects=objects, plan=PLAN)
        assert time.perf_counter() - start < 0.3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: r.exclude("observation"), r"must have the key 'observation' \(20×39\), got action"),
        (lambda r: r.exclude("action"), "must have the key 'action'"),
        (lambda r: r[None], r"batch size \(T,\) with T >= 1, got \(1, 20\); take one episode"),
        (lambda r: r[:0], r"got \(0,\)"),
        (
            lambda r: r.set("observation", torch.rand(20, 38)),
            r"'observation'\] must have shape 20×39, got 20×38",
        ),
        (
            lambda r: r.set("action", torch.full((20, 4), float("nan"))),
            r"'action'\] must be finite, .* row 0",
        ),
        (lambda r: r.set("qaf", torch.rand(20, 3)), r"'qaf'\] must be bool, got torch.float32"),
        (lambda r: r.set("qaf", torch.ones(20, 1, dtype=torch.bool)), "each of 2 plan steps, got 1"),
        (
            lambda r: r.set("skill_weights", torch.full((20, 3), torch.inf)),
            "'skill_weights'.* must be finite",
        ),
    ],
)
def test_wrong_rollouts_are_named(tmp_path, change, message):
    rollout = make_rollout()
    with RerunLogger(tmp_path / "a.rrd") as logger, pytest.raises(ValueError, match=message):
        logger.log_episode(change(rollout.clone()), task="push", objects=make_objects(rollout), plan=PLAN)


def test_wrong_objects_are_named(tmp_path):
    rollout = make_rollout()
    with RerunLogger(tmp_path / "a.rrd") as logger:
        with pytest.raises(ValueError, match=r"objects\['puck'\] must have shape 20×3, got 19×3"):
            logger.log_episode(rollout, task="push", objects={"puck": torch.rand(19, 3)})
        with pytest.raises(ValueError, match=r"objects\['puck'\] must be finite"):
            logger.log_episode(rollout, task="push", objects={"puck": torch.full((20, 3), float("nan"))})
        with pytest.raises(TypeError, match="objects must map names"):
            logger.log_episode(rollout, task="push", objects=[torch.rand(20, 3)])
        with pytest.raises(TypeError, match="rollout must be a TensorDict"):
            logger.log_episode({"observation": torch.rand(20, 39)}, task="push", objects={})
        with pytest.raises(ValueError, match="task must be"):
            logger.log_episode(rollout, task="", objects={})
    assert Recording(tmp_path / "a.rrd").entities() == {"/__properties"}


# -------------------------------------------------------------------- torchrl's Logger


def test_it_is_a_torchrl_logger(tmp_path):
    logger = RerunLogger(tmp_path / "runs" / "a.rrd")
    assert isinstance(logger, Logger)
    assert logger.start() is logger
    assert logger.is_alive
    assert logger.exp_name == "a"
    assert logger.log_dir == str(tmp_path / "runs")
    assert "open" in repr(logger)
    logger.shutdown()
    logger.shutdown()
    logger.close()
    assert not logger.is_alive
    assert "closed" in repr(logger)
    with pytest.raises(RuntimeError, match="cannot be restarted"):
        logger.start()
    with pytest.raises(RuntimeError, match="takes nothing more"):
        logger.log_scalar("loss", 1.0)


def test_scalars(tmp_path):
    with RerunLogger(tmp_path / "a.rrd", exp_name="run") as logger:
        for i in range(3000):
            logger.log_scalar("loss/bc", 1.0 / (i + 1), step=10 * i)
        logger.log_scalar("counted", 1)
        logger.log_scalar("counted", torch.tensor([2.0]))
        logger.log_metrics(TensorDict({"eval": {"success": torch.tensor(0.5)}}), step=7)
        logger.log_metrics({"nan": float("nan")}, step=0)
        with pytest.raises(ValueError, match="value of 'loss/bc' must be one number"):
            logger.log_scalar("loss/bc", [1.0, 2.0])
        with pytest.raises(ValueError, match="name must be"):
            logger.log_scalar("loss//bc", 1.0)
    found = Recording(tmp_path / "a.rrd")
    loss = "/metrics/loss/bc", "Scalars:scalars"
    assert found.values(*loss) == [[1.0 / (i + 1)] for i in range(3000)]
    assert found.times(*loss, "global_step") == list(range(0, 30000, 10))
    assert found.times("/metrics/counted", "Scalars:scalars", "global_step") == [0, 1]
    assert found.values("/metrics/eval/success", "Scalars:scalars") == [[0.5]]
    assert np.isnan(found.values("/metrics/nan", "Scalars:scalars")[0][0])


def test_counters_are_saved_and_restored(tmp_path):
    with RerunLogger(tmp_path / "a.rrd") as logger:
        logger.log_scalar("loss", 1.0)
        logger.log_scalar("loss", 1.0)
        state = logger.state_dict()
    with RerunLogger(tmp_path / "b.rrd") as logger:
        logger.load_state_dict(state)
        logger.log_scalar("loss", 1.0)
    assert Recording(tmp_path / "b.rrd").times("/metrics/loss", "Scalars:scalars", "global_step") == [2]


@pytest.mark.parametrize("channels", [1, 3])
def test_videos(tmp_path, channels):
    video = torch.randint(256, (4, channels, 6, 8), dtype=torch.uint8)
    with RerunLogger(tmp_path / "a.rrd") as logger:
        logger.log_video("plain", video)
        logger.log_video("batched", video[None], step=100, fps=10)
        logger.log_video("two", torch.stack([video, video]))
        for wrong in (video.float(), video[0], video[:0], video.expand(4, -1, 6, 8).repeat(1, 2, 1, 1)):
            with pytest.raises(ValueError, match="video 'wrong' must be uint8 of shape T×C×H×W"):
                logger.log_video("wrong", wrong)
    found = Recording(tmp_path / "a.rrd")
    for entity in ("/videos/plain", "/videos/batched/step\\ 100", "/videos/two/0", "/videos/two/1"):
        pixels = found.array(entity, "Image:buffer").reshape(4, 6, 8, channels)
        np.testing.assert_array_equal(pixels, video.permute(0, 2, 3, 1).numpy())
    seconds = found.times("/videos/batched/step\\ 100", "Image:buffer", "time")
    assert [int(second) for second in seconds] == [0, 100_000_000, 200_000_000, 300_000_000]


def test_torchrls_video_recorder(tmp_path):
    with RerunLogger(tmp_path / "a.rrd") as logger:
        recorder = VideoRecorder(logger, tag="rollout", skip=1, make_grid=False)
        frames = torch.randint(256, (5, 3, 4, 4), dtype=torch.uint8)
        for frame in frames:
            recorder._apply_transform(frame)
        recorder.dump()
    found = Recording(tmp_path / "a.rrd")
    (entity,) = {entity for entity in found.entities() if entity.startswith("/videos/")}
    pixels = found.array(entity, "Image:buffer").reshape(-1, 4, 4, 3)
    np.testing.assert_array_equal(pixels, frames[-len(pixels) :].permute(0, 2, 3, 1).numpy())


def test_hparams(tmp_path):
    with RerunLogger(tmp_path / "a.rrd") as logger:
        logger.log_hparams({"lr": 3e-4, "actor": {"width": 256, "note": "a|b"}})
        logger.log_hparams({"seed": 0})
        with pytest.raises(TypeError, match="cfg must be a mapping"):
            logger.log_hparams("lr=1")
    text = Recording(tmp_path / "a.rrd").values("/hparams", "TextDocument:text")[-1][0]
    for row in ("| lr | 0.0003 |", "| actor.width | 256 |", "| actor.note | a\\|b |", "| seed | 0 |"):
        assert row in text


def test_histograms(tmp_path):
    data = torch.randn(3, 50)
    with RerunLogger(tmp_path / "a.rrd") as logger:
        logger.log_histogram("actor/action", data, step=5, bins=7)
        logger.log_histogram("list", [1, 2, 2])
        for wrong in ([], [1.0, float("nan")]):
            with pytest.raises(ValueError, match="data of histogram 'wrong' must be finite and not empty"):
                logger.log_histogram("wrong", wrong)
    found = Recording(tmp_path / "a.rrd")
    counts, edges = np.histogram(data.double().numpy(), bins=7)
    entity = "/histograms/actor/action"
    assert found.times(entity, "BarChart:values", "global_step") == [5]
    assert [row[0]["buffer"] for row in found.values(entity, "BarChart:values")] == [counts.tolist()]
    centers = [row[0]["buffer"] for row in found.values(entity, "BarChart:abscissa")]
    assert centers == [((edges[1:] + edges[:-1]) / 2).tolist()]


# -------------------------------------------------------------------- the file


def test_no_file_before_the_end(tmp_path):
    path = tmp_path / "a.rrd"
    logger = RerunLogger(path)
    logger.log_scalar("loss", 1.0)
    logger.flush()
    assert not path.exists()
    logger.shutdown()
    assert os.listdir(tmp_path) == ["a.rrd"]


def test_ending_the_experiment_ends_the_logger(tmp_path):
    # What torchrl's service backends do instead of shutdown().
    logger = RerunLogger(tmp_path / "a.rrd")
    logger.log_scalar("loss", 1.0)
    logger.flush()
    logger.experiment.finish()
    assert not logger.is_alive
    assert "/metrics/loss" in Recording(tmp_path / "a.rrd").entities()


def test_an_older_file_is_replaced_at_the_end(tmp_path):
    path = tmp_path / "a.rrd"
    path.write_bytes(b"older")
    with RerunLogger(path) as logger:
        logger.log_scalar("loss", 1.0)
        assert path.read_bytes() == b"older"
    assert "/metrics/loss" in Recording(path).entities()


def test_an_error_leaves_the_path_untouched(tmp_path):
    path = tmp_path / "a.rrd"
    path.write_bytes(b"older")
    logger = RerunLogger(path)

    def interrupted():
        with logger:
            logger.log_episode(make_rollout(), task="push", objects={})
            raise KeyError("mine")

    with pytest.raises(KeyError):
        interrupted()
    assert not logger.is_alive
    assert path.read_bytes() == b"older"
    assert os.listdir(tmp_path) == ["a.rrd"]


def test_two_loggers_do_not_mix(tmp_path):
    import rerun as rr

    one, two = RerunLogger(tmp_path / "1.rrd"), RerunLogger(tmp_path / "2.rrd")
    one.log_scalar("a", 1.0)
    two.log_scalar("b", 1.0)
    assert rr.get_global_data_recording() is None
    one.shutdown()
    two.shutdown()
    assert Recording(tmp_path / "1.rrd").entities() == {"/__properties", "/metrics/a"}
    assert Recording(tmp_path / "2.rrd").entities() == {"/__properties", "/metrics/b"}


def test_wrong_paths_are_named(tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "folder.rrd").mkdir()
    for path, message in (
        (tmp_path / "a.txt", "must end in '.rrd'"),
        (tmp_path / ".rrd", "must end in '.rrd'"),
        (tmp_path / "folder.rrd", "must be a file, got the folder"),
        (tmp_path / "file" / "a.rrd", "'.*file' is a file"),
        (tmp_path / "file" / "below" / "a.rrd", "'.*file' is a file"),
    ):
        with pytest.raises(ValueError, match=message):
            RerunLogger(path)
    with pytest.raises(TypeError, match="path must be a path"):
        RerunLogger(None)


def test_importing_loads_no_rerun():
    code = "import sys, lw_torchrl.record; sys.exit('rerun' in sys.modules or 'rerun_bindings' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
