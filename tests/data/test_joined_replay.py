"""The replay buffer over several datasets and chosen episodes: rows, labels, descriptions."""

import json

import pytest
import torch
from collecting import collect

from lw_torchrl.data import JoinedDemonstrations, LanguageWorldExperienceReplay
from lw_torchrl.data.dataset import load_rows

STEPS = 50


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    """Two demonstrations each of button-press-topdown, push and reach."""
    tasks = ["reach", "push", "button-press-topdown"]
    root = tmp_path_factory.mktemp("made") / "base"
    return collect(root, tasks, episodes_per_task=2, seed=0, max_steps=STEPS, noise_scale=(0, 0.3))


@pytest.fixture(scope="module")
def target(tmp_path_factory):
    """Four demonstrations of reach, with another seed."""
    root = tmp_path_factory.mktemp("made") / "target"
    dataset = collect(root, "reach", episodes_per_task=4, seed=1, max_steps=STEPS, noise_scale=(0, 0.2))
    assert {e.success for e in dataset.episodes} == {True, False}, "the tests need successes and failures"
    return dataset


def expected_rows(part, episodes, after=None):
    """Return the rows of a dataset's episodes and their ends, by a loop over steps."""
    rows, kept, ends = load_rows(part), [], []
    for number, episode in enumerate(part.episodes):
        if episodes is not None and (episode.task, episode.episode) not in episodes:
            continue
        success = rows["next", "success"][episode.start : episode.start + episode.length].flatten().tolist()
        for t in range(episode.length):
            if after is None or not any(success) or t <= success.index(True) + after:
                kept.append(episode.start + t)
                ends.append(False)
        ends[-1] = True
        assert (rows["collector", "traj_ids"][kept[-1]]) == number
    return rows[torch.tensor(kept)], torch.tensor(ends)[:, None]


@pytest.mark.parametrize("label", ["expert", "unclipped", "executed"])
@pytest.mark.parametrize("after", [None, 0, 5, 20])
def test_rows_are_those_of_each_dataset(base, target, label, after):
    replay = LanguageWorldExperienceReplay(
        [base.root, target.root], episodes=[None, {"reach": [1, 3]}], label=label, after_success=after
    )
    first, first_ends = expected_rows(base, None, after)
    second, second_ends = expected_rows(target, [("reach", 1), ("reach", 3)], after)
    second.set(("collector", "traj_ids"), second["collector", "traj_ids"] + 6)
    expected = torch.cat([first, second])
    if label != "executed":
        expected["action"] = expected[f"{label}_action"]
        expected = expected.exclude("next", "expert_action", "unclipped_action")
    else:
        expected["next", "reward"] = expected["next", "reward_sparse"]
        ends = torch.cat([first_ends, second_ends])
        expected["next", "done"] = expected["next", "truncated"] = ends
    expected["behaviour"] = torch.zeros(len(expected), dtype=torch.int64)
    expected["dataset"] = torch.tensor([0] * len(first) + [1] * len(second))
    expected["is_demonstration"] = torch.ones(len(expected), dtype=torch.bool)
    rows = replay[:]
    assert len(replay) == len(expected)
    assert replay.behaviours == ("noisy",)
    assert set(rows.keys(True, True)) == set(expected.keys(True, True))
    assert (rows == expected).all()
    assert rows.device == LanguageWorldExperienceReplay(base.root)[:].device


@pytest.mark.parametrize(
    ("choice", "episodes"),
    [
        (1, [("button-press-topdown", 0), ("push", 0), ("reach", 0)]),
        ({"reach": 1}, [("reach", 0)]),
        ({"reach": [1], "push": 2}, [("push", 0), ("push", 1), ("reach", 1)]),
        ({"reach": (1, 0)}, [("reach", 0), ("reach", 1)]),
    ],
)
def test_episodes_are_chosen_from_one_dataset(base, choice, episodes):
    replay = LanguageWorldExperienceReplay(base.root, episodes=choice, label="executed")
    assert [(e.task, e.episode) for e in replay.demonstrations.episodes] == episodes
    rows = replay[:].exclude("behaviour", "is_demonstration", ("next", "reward"))
    assert (rows == expected_rows(base, episodes)[0]).all()
    assert replay.tasks == tuple(sorted({task for task, _ in episodes}))
    assert replay.demonstrations.num_steps == len(replay) == STEPS * len(episodes)
    assert replay.data_path_root == base.root
    (part,) = replay.demonstrations.parts
    assert part.success_rate.keys() == set(replay.tasks)


def test_the_description_names_datasets_and_episodes(base, target):
    replay = LanguageWorldExperienceReplay([base.root, str(target.root)], episodes=[1, {"reach": [2, 0]}])
    joined = replay.demonstrations
    assert isinstance(joined, JoinedDemonstrations)
    assert [part.root for part in joined.parts] == list(replay.roots) == [base.root, target.root]
    assert joined.config.episodes == ({"button-press-topdown": [0], "push": [0], "reach": [0]}, {"reach": [0, 2]})
    assert json.loads(json.dumps(joined.config.to_json()))["parts"][0] == base.config.to_json()
    for path in ("data_path_root", "data_path"):
        with pytest.raises(ValueError, match="joins 2 datasets"):
            getattr(replay, path)
