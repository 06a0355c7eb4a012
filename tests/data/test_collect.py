"""collect_demonstrations: the content of a dataset, and which episodes it holds."""

import json
from importlib.metadata import version

import metaworld
import numpy as np
import pytest
import torch
from collecting import EPISODES, NOISE, SEED, STEPS, TASKS, collect, interrupt_after, tree

import lw_torchrl as lw
from lw_torchrl.data import CollectConfig
from lw_torchrl.data.dataset import load_rows, read_metadata
from lw_torchrl.envs.rows import action_noise, episode_seed
from lw_torchrl.language.tasks import MT50
from lw_torchrl.suites.metaworld.environments import make_metaworld_env

CONFIG = CollectConfig(TASKS, EPISODES, SEED, noise_scale=NOISE, max_steps=STEPS)


def test_rows_have_the_documented_keys_shapes_and_dtypes(rows):
    total = len(TASKS) * EPISODES * STEPS
    expected = dict.fromkeys(["observation", ("next", "observation")], ((total, 39), torch.float32))
    expected |= dict.fromkeys(["action", "expert_action", "unclipped_action"], ((total, 4), torch.float32))
    numbers = ["task_id", "episode", ("collector", "traj_ids"), ("next", "task_id")]
    expected |= dict.fromkeys(numbers, ((total,), torch.int64))
    expected |= dict.fromkeys([("next", "reward_sparse"), ("next", "reward_dense")], ((total, 1), torch.float32))
    flags = ("success", "done", "terminated", "truncated")
    expected |= {("next", key): ((total, 1), torch.bool) for key in flags}
    assert rows.batch_size == (total,)
    assert {key: (tuple(rows[key].shape), rows[key].dtype) for key in rows.keys(True, True)} == expected


def test_episodes_are_consecutive_and_end_by_truncation(dataset, rows):
    assert [(e.task, e.episode) for e in dataset.episodes] == [(t, k) for t in TASKS for k in range(EPISODES)]
    ids = rows["collector", "traj_ids"].reshape(-1, STEPS)
    assert (ids == ids[:, :1]).all()
    assert ids[:, 0].unique().numel() == len(dataset.episodes)
    for number, episode in enumerate(dataset.episodes):
        assert (episode.start, episode.length) == (number * STEPS, STEPS)
        part = rows[episode.start : episode.start + episode.length]
        for key, value in (("task_id", MT50.index(episode.task)), ("episode", episode.episode)):
            assert (part[key] == value).all()
        assert torch.equal(part["next", "task_id"], part["task_id"])
        assert torch.equal(part["observation"][1:], part["next", "observation"][:-1])
        assert not part["next", "terminated"].any()
        for key in ("done", "truncated"):
            assert part["next", key].flatten().tolist() == [False] * (STEPS - 1) + [True]


def test_metadata_record_configuration_and_versions(dataset):
    assert dataset.config == CONFIG
    assert dataset.num_steps == len(TASKS) * EPISODES * STEPS
    metadata = json.loads((dataset.root / "metadata.json").read_text())
    assert metadata["config"] == CONFIG.to_json()
    packages = ("metaworld", "mujoco", "numpy", "tensordict", "torch", "torchrl")
    assert metadata["versions"] == {name: version(name) for name in packages} | {"lw_torchrl": lw.__version__}
    assert read_metadata(dataset.root) == dataset
    assert metadata["task_ids"] == dataset.task_ids == {task: MT50.index(task) for task in TASKS}
    assert not (dataset.root / ".partial").exists()


def test_success_is_recorded_for_each_episode(tmp_path):
    dataset = collect(tmp_path / "demos", "reach", max_steps=50, episodes_per_task=4, noise_scale=0.0, seed=0)
    rows = load_rows(dataset)
    for episode in dataset.episodes:
        success = rows["next", "success"][episode.start : episode.start + episode.length].flatten().tolist()
        assert episode.success == any(success)
        assert episode.first_success == (success.index(True) + 1 if any(success) else None)
    rate = sum(e.success for e in dataset.episodes) / 4
    assert 0 < rate < 1, "the test needs successes and failures"
    assert dataset.success_rate == {"reach": rate}


@pytest.mark.parametrize("hold", [1, 4])
def test_executed_action_is_the_experts_plus_noise_clipped(tmp_path, hold):
    rows = load_rows(dataset := collect(tmp_path / "demos", noise_hold=hold))
    for episode in dataset.episodes:
        part = rows[episode.start : episode.start + STEPS]
        scale = NOISE[episode.episode % len(NOISE)]
        noise = action_noise(episode.task, SEED, episode.episode, -(-STEPS // hold)).repeat(hold, 0)[:STEPS]
        noise = torch.from_numpy(noise * np.float32([scale] * 3 + [scale * 0.2]))
        assert torch.equal(part["action"], (part["expert_action"] + noise).clamp(-1, 1))
        assert torch.equal(part["action"], part["expert_action"]) == (scale == 0)
        assert part["expert_action"].abs().max() <= 1


@pytest.mark.filterwarnings("ignore:Constant.s. may be too high")
@pytest.mark.parametrize("task", TASKS)
def test_unclipped_action_is_that_of_metaworlds_script(rows, task):
    script = metaworld.policies.ENV_POLICY_MAP[f"{task}-v3"]()
    part = rows[rows["task_id"] == MT50.index(task)]
    actions = [script.get_action(observation.astype(np.float64)) for observation in part["observation"].numpy()]
    assert np.array_equal(part["unclipped_action"].numpy(), np.stack(actions).astype(np.float32))
    assert torch.equal(part["unclipped_action"].clamp(-1, 1), part["expert_action"])
    assert rows["unclipped_action"].abs().max() > 1, "the test needs an action that is clipped"


@pytest.mark.parametrize("task", TASKS)
def test_stored_actions_reproduce_observations_and_rewards_in_metaworld(dataset, rows, task):
    env = make_metaworld_env(task)
    for episode in (e for e in dataset.episodes if e.task == task):
        part = rows[episode.start : episode.start + STEPS]
        env.seed(episode_seed(task, SEED, episode.episode))
        observation, _ = env.reset()
        for t in range(STEPS):
            assert np.array_equal(part["observation"][t].numpy(), observation.astype(np.float32))
            observation, reward, _, _, info = env.step(part["action"][t].numpy())
            assert np.array_equal(part["next", "observation"][t].numpy(), observation.astype(np.float32))
            assert part["next", "success"][t].item() == part["next", "reward_sparse"][t].item() == info["success"]
            assert part["next", "reward_dense"][t].item() == np.float32(reward)
    env.close()


REDRAW = dict(tasks="reach", episodes_per_task=3, max_steps=50, noise_scale=(0.4,))


@pytest.fixture(scope="module")
def redrawn(tmp_path_factory):
    return collect(tmp_path_factory.mktemp("redrawn") / "demos", redraw_failures=True, **REDRAW)


def test_redrawing_keeps_only_the_first_successes(redrawn, tmp_path):
    attempts = redrawn.attempts["reach"]
    everything = collect(tmp_path / "demos", **{**REDRAW, "episodes_per_task": attempts})
    successes = [e.episode for e in everything.episodes if e.success]
    assert len(successes) < attempts, "the test needs a failure"
    assert [e.episode for e in redrawn.episodes] == successes
    assert redrawn.success_rate == {"reach": 1.0}
    all_rows, kept_rows = load_rows(everything), load_rows(redrawn)
    expected = all_rows[torch.isin(all_rows["episode"], torch.tensor(successes))]
    assert (kept_rows.exclude("collector") == expected.exclude("collector")).all()


def test_redrawing_resumes_after_an_interruption(redrawn, tmp_path, monkeypatch):
    interrupt_after(monkeypatch, 2)
    with pytest.raises(KeyboardInterrupt):
        collect(tmp_path / "demos", redraw_failures=True, num_envs=1, **REDRAW)
    monkeypatch.undo()
    collect(tmp_path / "demos", redraw_failures=True, **REDRAW)
    assert tree(tmp_path / "demos") == tree(redrawn.root)
