"""Demonstrations that end at success: as the environment ends them, mixed only with rows that end alike."""

import pytest
import torch

import lw_torchrl as lw

TASKS = ["push", "reach"]


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    root = tmp_path_factory.mktemp("made") / "demos"
    lw.collect_demonstrations(TASKS, episodes_per_task=2, root=root, max_steps=90, noise_scale=0.1, progress=False)
    return root


def opened(root, **options):
    return lw.LanguageWorldExperienceReplay(root, **{"label": "executed", "terminate_on_success": True, **options})


def played_again(found, episode):
    """What an episode's executed actions lead to in an environment that ends at success."""
    rows = lw.LanguageWorldExperienceReplay(found.root, label="executed")[:]
    actions = rows["action"][episode.start : episode.start + episode.length]
    env = lw.LanguageWorldEnv(episode.task, seed=found.config.seed, max_steps=90, terminate_on_success=True)
    state = env.reset(episode=episode.episode)
    seen = []
    for action in actions:
        state["action"] = action.unsqueeze(0)
        state = env.step(state)["next"]
        seen.append(state.clone())
        if state["done"].any():
            break
    env.close()
    return torch.cat(seen)


def test_an_episode_ends_as_the_environment_ends_it(root):
    replay = opened(root)
    rows = replay[:]
    succeeded = [episode.success for episode in replay.demonstrations.episodes]
    assert any(succeeded)
    for number, episode in enumerate(replay.demonstrations.episodes):
        mine = rows[rows["collector", "traj_ids"] == number]
        again = played_again(replay.demonstrations, episode)
        for key in ("observation", "reward", "success", "done", "terminated", "truncated"):
            assert torch.equal(mine["next", key], again[key]), (episode, key)


def test_it_is_bootstrapped_from_nothing_n_steps_ahead(root):
    rows = opened(root, n_steps=5, gamma=0.99)[:]
    assert torch.equal(rows["next", "terminated"], rows["next", "success"])
    assert (rows["next", "reward"][rows["next", "terminated"]] > 0).all()
