"""LanguageWorldExperienceReplay: rows, labels, ends of episodes, transforms, columns, joined datasets, saved state."""

import functools
import json
import os
import pickle

import pytest
import torch
from collecting import KINDS, Evil, collect, open_replay, tree
from tensordict import TensorDict
from torchrl.checkpoint import Checkpoint
from torchrl.data import RandomSampler, SamplerWithoutReplacement, SliceSampler
from torchrl.envs import Compose, MultiStepTransform, ObservationNorm, RandomCropTensorDict, RewardScaling, RewardSum
from torchrl.envs.transforms import BatchSizeTransform, CatFrames, Reward2GoTransform

import lw_torchrl as lw
from lw_torchrl.data import CoLearningSampler, JoinedDemonstrations, LanguageWorldExperienceReplay, TaskBalancedSampler
from lw_torchrl.data.dataset import load_rows
from lw_torchrl.language.query_program import QueryProgram

PLANS = lw.load_plans("MT10")
SLICES = functools.partial(SliceSampler, slice_len=4, traj_key=("collector", "traj_ids"))
FRAMES = functools.partial(CatFrames, 3, -1, in_keys=["observation"], out_keys=["frames"])
RESHAPE = functools.partial(BatchSizeTransform, reshape_fn=lambda rows: rows.reshape(-1, 4).refine_names(None, "time"))


@pytest.mark.parametrize("label", ["expert", "executed"])
def test_a_transform_answers_the_plans_queries(dataset, label):
    replay = open_replay(dataset.root, batch_size=32, label=label, transform=lw.QAFTransform(PLANS))
    batch = replay.sample()
    program = QueryProgram({task: [step.condition for step in plan.steps] for task, plan in PLANS.items()})
    assert torch.equal(batch["qaf"], program(batch["observation"], batch["task_id"]))
    assert (("next", "qaf") in batch.keys(True)) == (label == "executed")
    if label == "executed":
        following = program(batch["next", "observation"], batch["next", "task_id"])
        assert torch.equal(batch["next", "qaf"], following)


@pytest.mark.parametrize("sampler", [TaskBalancedSampler, lambda: CoLearningSampler("push")])
def test_prefetching_one_batch_gives_the_same_batches(dataset, sampler):
    opened = functools.partial(open_replay, dataset.root, transform=lw.QAFTransform(PLANS))
    ahead, now = (opened(sampler=sampler(), prefetch=prefetch) for prefetch in (1, None))
    for _ in range(40):
        assert (ahead.sample() == now.sample()).all()
    assert ahead._prefetch_queue


@pytest.mark.parametrize("make", [lambda: MultiStepTransform(3, 0.9), Reward2GoTransform])
def test_transforms_of_written_rows_are_errors(dataset, make):
    for transform in (make(), Compose(RewardScaling(0.0, 1.0), Compose(make()))):
        with pytest.raises(ValueError, match=f"transform: {type(make()).__name__}"):
            LanguageWorldExperienceReplay(dataset.root, label="executed", transform=transform)


@pytest.mark.parametrize("sampler", [None, RandomSampler, lw.TaskBalancedSampler, SamplerWithoutReplacement, SLICES])
@pytest.mark.parametrize("make", [FRAMES, RewardSum, lambda: RandomCropTensorDict(2)], ids=range(3))
def test_transforms_over_time_need_slices(dataset, make, sampler):
    open_buffer = functools.partial(LanguageWorldExperienceReplay, dataset.root, label="executed", batch_size=8)
    message = f"transform: {type(make()).__name__} reads consecutive .*; use sampler=SliceSampler.*BatchSizeTransform"
    with pytest.raises(ValueError, match=message):
        open_buffer(sampler=sampler, transform=Compose(RewardScaling(0.0, 1.0), make()))
    replay = open_buffer(sampler=sampler)
    for add in (replay.append_transform, functools.partial(replay.insert_transform, 0)):
        with pytest.raises(ValueError, match=message):
            add(make())
    replay.sample()
    sliced = open_buffer(sampler=SLICES(), transform=Compose(RESHAPE(), make()))
    if sampler not in (None, SLICES):
        with pytest.raises(ValueError, match=message):
            sliced.set_sampler(sampler())


def test_frames_of_slices_are_of_one_episode(dataset):
    rows = LanguageWorldExperienceReplay(dataset.root, label="executed")[:]
    transform = Compose(RESHAPE(), FRAMES(), BatchSizeTransform(reshape_fn=lambda rows: rows.reshape(-1)))
    options = dict(label="executed", batch_size=32, sampler=SLICES(), transform=transform)
    batch = LanguageWorldExperienceReplay(dataset.root, **options).sample()
    for frames, episode in zip(batch["frames"].unflatten(-1, (3, -1)), batch["collector", "traj_ids"], strict=True):
        for frame in frames:
            assert episode in rows["collector", "traj_ids"][(rows["observation"] == frame).all(-1)]


def test_an_inverse_transform_changes_samples(dataset):
    plain, inverse = (open_replay(dataset.root, batch_size=4) for _ in range(2))
    inverse.append_transform(ObservationNorm(0.0, 2.0, in_keys=[], in_keys_inv=["observation"]), invert=True)
    assert not torch.equal(inverse.sample()["observation"], plain.sample()["observation"])


@pytest.fixture(scope="module")
def ending(tmp_path_factory):
    """Two demonstrations each of push and reach, which succeed within 90 steps."""
    root = tmp_path_factory.mktemp("ending") / "demos"
    return collect(root, episodes_per_task=2, seed=0, noise_scale=0.1, max_steps=90)


def test_episodes_end_as_in_an_environment_that_ends_at_success(ending):
    """The executed actions lead to the same states in such an environment."""
    rows = open_replay(ending.root, label="executed", terminate_on_success=True)[:]
    assert any(episode.success for episode in ending.episodes)
    for number, episode in enumerate(ending.episodes):
        env = lw.LanguageWorldEnv(episode.task, seed=0, max_steps=90, terminate_on_success=True)
        state, states = env.reset(episode=episode.episode), []
        for action in load_rows(ending)["action"][episode.start : episode.start + episode.length]:
            state = env.step(state.set("action", action.unsqueeze(0)))["next"]
            states.append(state.clone())
            if state["done"].any():
                break
        env.close()
        of_episode, expected = rows[rows["collector", "traj_ids"] == number], torch.cat(states)
        for key in ("observation", "reward", "success", "done", "terminated", "truncated"):
            assert torch.equal(of_episode["next", key], expected[key]), (episode, key)


@pytest.mark.parametrize("ends", [dict(), dict(after_success=4), dict(terminate_on_success=True)])
def test_n_steps_end_with_the_episode(ending, ends):
    rows, ahead = (open_replay(ending.root, kind, reward="dense", **ends)[:] for kind in ("executed", "n steps"))
    assert (ahead == lw.data.n_step_returns(rows, 3, 0.9)).all()
    assert ahead["next", "done"].sum() == 3 * len(ending.episodes)


def drawn(replay, batches=4):
    return torch.cat([replay.sample() for _ in range(batches)])


@pytest.mark.parametrize("kind", ["expert", "cut", "chosen", "n steps"])
@pytest.mark.parametrize("sampler", [TaskBalancedSampler, RandomSampler, SamplerWithoutReplacement])
@pytest.mark.parametrize("prefetch", [None, 1])
def test_a_restored_buffer_gives_the_same_batches(dataset, tmp_path, kind, sampler, prefetch):
    replay = open_replay(dataset.root, kind, sampler=sampler(), prefetch=prefetch)
    drawn(replay)
    replay.dumps(tmp_path / "saved")
    assert len(list((tmp_path / "saved").iterdir())) == 1
    expected = drawn(replay, 20)
    again = open_replay(dataset.root, kind, seed=9, sampler=sampler(), prefetch=prefetch)
    drawn(again, 3)
    again.loads(tmp_path / "saved")
    batches = drawn(again, 20)
    assert type(batches) is TensorDict
    assert (batches == expected).all()


@pytest.mark.parametrize("kind", KINDS)
def test_a_state_of_other_rows_is_an_error(dataset, other_dataset, tmp_path, kind):
    replay = open_replay(other_dataset.root, kind)
    replay.dumps(tmp_path / "saved")
    before = tree(dataset.root), tree(other_dataset.root)
    own = open_replay(dataset.root, kind)
    with pytest.raises(ValueError, match="other rows"):
        own.loads(tmp_path / "saved")
    with pytest.raises(ValueError, match="state_dict"):
        own.load_state_dict(replay.state_dict())
    assert (tree(dataset.root), tree(other_dataset.root)) == before
    assert len(drawn(own)) == 32


def test_torchrls_checkpoint_of_a_buffer_holds_no_pickle(dataset, tmp_path):
    replay = open_replay(dataset.root)
    Checkpoint(replay=replay).save(tmp_path / "checkpoint")
    expected = drawn(replay)
    again = open_replay(dataset.root, seed=7)
    Checkpoint(replay=again).load(tmp_path / "checkpoint")
    assert (drawn(again) == expected).all()
    assert not [path for path in (tmp_path / "checkpoint").rglob("*") if path.suffix in (".pkl", ".pickle", ".pt")]


def test_planted_pickles_are_never_executed(dataset, tmp_path):
    folder, trace = tmp_path / "saved", tmp_path / "executed"
    replay = open_replay(dataset.root)
    replay.dumps(folder)
    for name in (*os.listdir(folder), "prefetch.pkl", "other.pickle", "transform.t"):
        (folder / name).write_bytes(pickle.dumps(Evil(trace)))
    with pytest.raises(ValueError, match=f"path: '{folder}' holds no"):
        replay.loads(folder)
    assert not trace.exists()


def numbered(replay):
    return torch.arange(len(replay), dtype=torch.float32)[:, None]


@pytest.mark.parametrize("folders", [1, 2])
@pytest.mark.parametrize("kind", ["executed", "expert", "cut", "n steps"])
@pytest.mark.parametrize("sampler", [RandomSampler, TaskBalancedSampler])
def test_batches_hold_the_column_of_each_row(both, folders, kind, sampler):
    replay = open_replay(both[:folders], kind, batch_size=12, sampler=sampler(), device="cpu")
    before, values = replay[:], numbered(replay)
    replay.add_column("advantage", values)
    replay.add_column("pair", torch.stack([values, -values], -1))
    assert torch.equal(replay[:]["advantage"], values)
    assert (replay[:].exclude("advantage", "pair") == before).all()
    assert torch.equal(replay[5]["advantage"], values[5])
    for _ in range(4):
        batch = replay.sample()
        assert torch.equal(batch["advantage"], values[batch["index"]])
        assert torch.equal(batch["pair"], torch.stack([values, -values], -1)[batch["index"]])
        assert torch.equal(batch["observation"], before["observation"][batch["index"]])


def test_a_column_is_a_copy_without_a_graph(dataset):
    replay = open_replay(dataset.root)
    replay.add_column("advantage", numbered(replay).requires_grad_() * 2)
    assert not replay.sample()["advantage"].requires_grad
    plain = numbered(replay)
    replay.add_column("other", plain)
    plain.fill_(7)
    assert torch.equal(replay[:]["other"], numbered(replay))


@pytest.mark.parametrize("kind", ["executed", "n steps"])
def test_a_column_does_not_change_batches_and_state(both, kind):
    plain, columned, again = (open_replay(both, kind, sampler=TaskBalancedSampler()) for _ in range(3))
    assert (plain.sample() == columned.sample()).all()
    for replay in (columned, again):
        replay.add_column("advantage", numbered(replay))
    state = columned.state_dict()
    assert set(state["_sampler"]) == set(plain.state_dict()["_sampler"])
    again.load_state_dict(state)
    for _ in range(5):
        expected = plain.sample()
        for batch in (columned.sample(), again.sample()):
            assert torch.equal(batch["advantage"].flatten(), expected["index"].float())
            assert (batch.exclude("advantage") == expected).all()


def test_values_of_other_rows_are_errors(both):
    replay, ahead, turned = (open_replay(roots, "n steps") for roots in (both, both, both[::-1]))
    replay.add_column("advantage", numbered(ahead), of=ahead)
    assert len(turned) == len(replay)
    with pytest.raises(ValueError, match="must hold this buffer's rows"):
        replay.add_column("other", numbered(turned), of=turned)


@pytest.fixture(scope="module")
def target(tmp_path_factory):
    """Four demonstrations of reach, with another seed."""
    root = tmp_path_factory.mktemp("made") / "target"
    dataset = collect(root, "reach", episodes_per_task=4, seed=1, max_steps=50, noise_scale=(0, 0.2))
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
def test_rows_are_those_of_each_dataset(ending, target, label, after):
    roots, episodes = [ending.root, target.root], [None, {"reach": [1, 3]}]
    replay = open_replay(roots, episodes=episodes, label=label, after_success=after)
    first, first_ends = expected_rows(ending, None, after)
    second, second_ends = expected_rows(target, [("reach", 1), ("reach", 3)], after)
    second.set(("collector", "traj_ids"), second["collector", "traj_ids"] + 4)
    expected = torch.cat([first, second])
    if label != "executed":
        expected["action"] = expected[f"{label}_action"]
        expected = expected.exclude("next", "expert_action", "unclipped_action")
    else:
        expected["next", "reward"] = expected["next", "reward_sparse"]
        expected["next", "done"] = expected["next", "truncated"] = torch.cat([first_ends, second_ends])
    expected["behaviour"] = torch.zeros(len(expected), dtype=torch.int64)
    expected["dataset"] = torch.tensor([0] * len(first) + [1] * len(second))
    expected["is_demonstration"] = torch.ones(len(expected), dtype=torch.bool)
    assert replay.behaviours == ("noisy",)
    assert set(replay[:].keys(True, True)) == set(expected.keys(True, True))
    assert (replay[:] == expected).all()


@pytest.mark.parametrize(
    ("choice", "episodes"),
    [
        (1, [("push", 0), ("reach", 0)]),
        ({"reach": 1}, [("reach", 0)]),
        ({"reach": [1], "push": 2}, [("push", 0), ("push", 1), ("reach", 1)]),
        ({"reach": (1, 0)}, [("reach", 0), ("reach", 1)]),
    ],
)
def test_episodes_are_chosen_from_one_dataset(ending, choice, episodes):
    replay = open_replay(ending.root, episodes=choice, label="executed")
    assert [(e.task, e.episode) for e in replay.demonstrations.episodes] == episodes
    rows = replay[:].exclude("behaviour", "is_demonstration", ("next", "reward"))
    assert (rows == expected_rows(ending, episodes)[0]).all()
    assert replay.tasks == tuple(sorted({task for task, _ in episodes}))
    assert replay.demonstrations.num_steps == len(replay) == 90 * len(episodes)
    assert replay.data_path_root == ending.root


def test_the_description_names_datasets_and_episodes(ending, target):
    replay = open_replay([ending.root, str(target.root)], episodes=[1, {"reach": [2, 0]}])
    joined = replay.demonstrations
    assert isinstance(joined, JoinedDemonstrations)
    assert [part.root for part in joined.parts] == list(replay.roots) == [ending.root, target.root]
    assert joined.config.episodes == ({"push": [0], "reach": [0]}, {"reach": [0, 2]})
    assert json.loads(json.dumps(joined.config.to_json()))["parts"][0] == ending.config.to_json()
    for path in ("data_path_root", "data_path"):
        with pytest.raises(ValueError, match="joins 2 datasets"):
            getattr(replay, path)
