"""Demonstrations: what they hold, and the arguments of collecting them."""

from __future__ import annotations

import json
from importlib.metadata import version

import metaworld
import numpy as np
import pytest
import torch
from collecting import EPISODES, NOISE, SEED, STEPS, TASKS, collect

import lw_torchrl as lw
from lw_torchrl.data import CollectConfig
from lw_torchrl.data.dataset import load_rows, read_metadata
from lw_torchrl.envs.language_world_env import LanguageWorldEnv
from lw_torchrl.envs.seeding import action_noise, episode_seed
from lw_torchrl.language.tasks import MT50
from lw_torchrl.suites.metaworld.experts import ExpertActor
from lw_torchrl.suites.metaworld.plain_engine import make_metaworld_env

CONFIG = CollectConfig(TASKS, EPISODES, SEED, noise_scale=NOISE, max_steps=STEPS)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return collect(tmp_path_factory.mktemp("made") / "demos")


@pytest.fixture(scope="module")
def rows(made):
    return load_rows(made)


# ---- what a dataset holds


def test_the_rows_have_the_documented_keys_shapes_and_dtypes(rows):
    total = len(TASKS) * EPISODES * STEPS
    number, flag = torch.int64, torch.bool
    expected = {
        "observation": ((total, 39), torch.float32),
        "task_id": ((total,), number),
        "episode": ((total,), number),
        "action": ((total, 4), torch.float32),
        "expert_action": ((total, 4), torch.float32),
        "unclipped_action": ((total, 4), torch.float32),
        ("collector", "traj_ids"): ((total,), number),
        ("next", "observation"): ((total, 39), torch.float32),
        ("next", "task_id"): ((total,), number),
        ("next", "reward_sparse"): ((total, 1), torch.float32),
        ("next", "reward_dense"): ((total, 1), torch.float32),
        **{("next", key): ((total, 1), flag) for key in ("success", "done", "terminated", "truncated")},
    }
    assert rows.batch_size == (total,)
    found = {key: (tuple(rows[key].shape), rows[key].dtype) for key in rows.keys(True, True)}
    assert found == expected


def test_episodes_lie_one_after_another_and_end_by_truncation(made, rows):
    assert [(e.task, e.episode) for e in made.episodes] == [(t, k) for t in TASKS for k in range(EPISODES)]
    ids = rows["collector", "traj_ids"].reshape(-1, STEPS)
    assert (ids == ids[:, :1]).all()
    assert ids[:, 0].unique().numel() == len(made.episodes)
    for number, episode in enumerate(made.episodes):
        assert (episode.start, episode.length) == (number * STEPS, STEPS)
        part = rows[episode.start : episode.start + episode.length]
        assert (part["task_id"] == MT50.index(episode.task)).all()
        assert (part["next", "task_id"] == MT50.index(episode.task)).all()
        assert (part["episode"] == episode.episode).all()
        assert torch.equal(part["observation"][1:], part["next", "observation"][:-1])
        assert not part["next", "terminated"].any()
        for key in ("done", "truncated"):
            assert part["next", key].flatten().tolist() == [False] * (STEPS - 1) + [True]


@pytest.mark.parametrize("kind", ["sparse", "dense"])
@pytest.mark.parametrize("task", TASKS)
def test_both_rewards_are_those_of_an_environment_with_that_reward(made, rows, task, kind):
    env = LanguageWorldEnv(task, num_envs=EPISODES, seed=SEED, max_steps=STEPS, reward=kind)
    first = next(episode.start for episode in made.episodes if episode.task == task)
    part = rows[first : first + EPISODES * STEPS].reshape(EPISODES, STEPS)
    state = env.reset()
    assert torch.equal(state["episode"], part["episode"][:, 0])
    for t in range(STEPS):
        state = env.step(state.set("action", part["action"][:, t].clone()))["next"]
        assert torch.equal(state["reward"], part["next", f"reward_{kind}"][:, t])
    assert kind == "sparse" or part["next", "reward_dense"].unique().numel() > STEPS
    env.close()


def test_the_metadata_say_how_it_was_made(made, tmp_path):
    assert made.config == CONFIG
    assert made.num_steps == len(TASKS) * EPISODES * STEPS
    found = json.loads((made.root / "metadata.json").read_text())
    assert found["config"] == CONFIG.to_json()
    assert found["config"]["seed"] == SEED
    packages = ("metaworld", "mujoco", "numpy", "tensordict", "torch", "torchrl")
    assert found["versions"] == {name: version(name) for name in packages} | {"lw_torchrl": lw.__version__}
    assert read_metadata(made.root) == made
    assert found["task_ids"] == made.task_ids == {task: MT50.index(task) for task in TASKS}
    assert not (made.root / ".partial").exists()


def test_success_is_recorded_episode_by_episode(tmp_path):
    made = collect(tmp_path / "demos", "reach", max_steps=50, episodes_per_task=4, noise_scale=0.0, seed=0)
    rows = load_rows(made)
    for episode in made.episodes:
        hits = rows["next", "success"][episode.start : episode.start + episode.length].flatten().nonzero().flatten()
        assert episode.success == (len(hits) > 0)
        assert episode.first_success == (int(hits[0]) + 1 if len(hits) else None)
    rate = sum(e.success for e in made.episodes) / 4
    assert 0 < rate < 1, "the test wants successes and failures"
    assert made.success_rate == {"reach": rate}


# ---- actions


def test_the_executed_action_is_the_experts_plus_the_episodes_own_noise_clipped(made, rows):
    for episode in made.episodes:
        part = rows[episode.start : episode.start + STEPS]
        scale = NOISE[episode.episode % len(NOISE)]
        noise = action_noise(episode.task, SEED, episode.episode, STEPS) * np.float32([scale] * 3 + [scale * 0.2])
        expected = (part["expert_action"] + torch.from_numpy(noise)).clamp(-1, 1)
        assert torch.equal(part["action"], expected)
        assert torch.equal(part["action"], part["expert_action"]) == (scale == 0)
        assert part["action"].abs().max() <= 1
        assert part["expert_action"].abs().max() <= 1


def test_held_noise_keeps_each_draw(tmp_path):
    made = collect(tmp_path / "demos", "reach", episodes_per_task=2, noise_scale=0.05, noise_hold=4, seed=2)
    rows = load_rows(made)
    draws = action_noise("reach", 2, 1, 4) * np.float32([0.05, 0.05, 0.05, 0.01])
    part = rows[STEPS:]
    expected = (part["expert_action"] + torch.from_numpy(draws.repeat(4, 0)[:STEPS])).clamp(-1, 1)
    assert torch.equal(part["action"], expected)


def test_the_expert_action_is_what_the_expert_wants_in_the_stored_state(rows):
    wanted = ExpertActor(TASKS)(rows.select("observation", "task_id").clone())["action"]
    assert torch.equal(wanted, rows["expert_action"])


@pytest.mark.filterwarnings("ignore:Constant.s. may be too high")
@pytest.mark.parametrize("task", TASKS)
def test_the_unclipped_action_is_what_meta_worlds_own_script_asks_for(rows, task):
    script = metaworld.policies.ENV_POLICY_MAP[f"{task}-v3"]()
    part = rows[rows["task_id"] == MT50.index(task)]
    asked = [script.get_action(observation.astype(np.float64)) for observation in part["observation"].numpy()]
    assert np.array_equal(part["unclipped_action"].numpy(), np.stack(asked).astype(np.float32))
    assert torch.equal(part["unclipped_action"].clamp(-1, 1), part["expert_action"])
    assert rows["unclipped_action"].abs().max() > 1, "the test wants an action that is clipped"


@pytest.mark.parametrize("task", TASKS)
def test_replayed_in_meta_worlds_own_environment_the_actions_give_the_observations(made, rows, task):
    env = make_metaworld_env(task)
    for episode in (e for e in made.episodes if e.task == task):
        part = rows[episode.start : episode.start + STEPS]
        env.seed(episode_seed(task, SEED, episode.episode))
        observation, _ = env.reset()
        for t in range(STEPS):
            assert np.array_equal(part["observation"][t].numpy(), observation.astype(np.float32))
            observation, _, _, _, info = env.step(part["action"][t].numpy())
            assert np.array_equal(part["next", "observation"][t].numpy(), observation.astype(np.float32))
            assert bool(part["next", "success"][t]) == bool(info["success"])
    env.close()


# ---- arguments


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (dict(tasks="raech"), "reach"),
        (dict(episodes_per_task=0), "episodes_per_task must be at least 1, got 0"),
        (dict(noise_scale=-0.1), "noise_scale must be finite and at least 0, got -0.1"),
        (dict(num_envs=1), "num_envs must be at least the number of tasks, 2, got 1"),
    ],
)
def test_wrong_arguments_are_named(tmp_path, changed, message):
    with pytest.raises(ValueError, match=message):
        collect(tmp_path / "demos", **changed)
