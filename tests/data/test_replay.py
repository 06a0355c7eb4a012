"""LanguageWorldExperienceReplay: rows, labels, rewards, ends of episodes, transforms, columns and its saved state."""

import functools
import pickle

import pytest
import torch
from collecting import Evil, collect, tree
from tensordict import TensorDict
from torchrl.checkpoint import Checkpoint
from torchrl.data import RandomSampler, SamplerWithoutReplacement, SliceSampler
from torchrl.envs.transforms import (
    BatchSizeTransform,
    CatFrames,
    Compose,
    MultiStepTransform,
    ObservationNorm,
    RandomCropTensorDict,
    Reward2GoTransform,
    RewardScaling,
    RewardSum,
)

import lw_torchrl as lw
from lw_torchrl.data import CoLearningSampler, LanguageWorldExperienceReplay, TaskBalancedSampler
from lw_torchrl.data.dataset import load_rows
from lw_torchrl.language.query_program import QueryProgram

STEPS = 50
PLANS = lw.load_plans("MT10")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Two failures, then successes at steps 36 and 48, of 50."""
    root = tmp_path_factory.mktemp("made") / "demos"
    dataset = collect(root, "reach", episodes_per_task=4, seed=0, max_steps=STEPS)
    assert {e.success for e in dataset.episodes} == {True, False}, "the tests need successes and failures"
    return dataset


@pytest.mark.parametrize("label", ["expert", "executed"])
@pytest.mark.parametrize("after", [0, 1, 5, 13, 20, 499])
def test_after_success_drops_exactly_the_later_rows(made, label, after):
    rows, kept, last = load_rows(made), [], []
    for episode in made.episodes:
        for t in range(episode.length):
            successes = [h for h in range(episode.length) if rows["next", "success"][episode.start + h]]
            if not successes or t <= successes[0] + after:
                kept.append(episode.start + t)
                if t == episode.length - 1 or (successes and t == successes[0] + after):
                    last.append(episode.start + t)
    assert len(kept) < len(rows) or after > 13
    replay = LanguageWorldExperienceReplay(made.root, label=label, after_success=after)
    shown, expected = replay[:], rows[torch.tensor(kept)]
    assert len(replay) == len(kept)
    assert torch.equal(shown["observation"], expected["observation"])
    assert torch.equal(shown["action"], expected["expert_action" if label == "expert" else "action"])
    if label == "executed":
        ends = torch.isin(torch.tensor(kept), torch.tensor(last))
        for key in ("done", "truncated"):
            assert torch.equal(shown["next", key].flatten(), ends)
        assert not shown["next", "terminated"].any()
        for key in ("observation", "reward_dense", "success"):
            assert torch.equal(shown["next", key], expected["next", key])
        assert torch.equal(shown["next", "reward"], expected["next", "success"].float())


@pytest.mark.parametrize("label", ["expert", "executed"])
def test_a_transform_answers_the_plans_queries(made, label):
    replay = LanguageWorldExperienceReplay(made.root, batch_size=32, label=label, transform=lw.QAFTransform(PLANS))
    batch = replay.sample()
    program = QueryProgram({task: [step.condition for step in plan.steps] for task, plan in PLANS.items()})
    assert batch["qaf"].dtype == torch.bool
    assert batch["qaf"].shape == (32, PLANS.num_steps)
    assert torch.equal(batch["qaf"], program(batch["observation"], batch["task_id"]))
    assert (("next", "qaf") in batch.keys(True)) == (label == "executed")
    if label == "executed":
        following = program(batch["next", "observation"], batch["next", "task_id"])
        assert torch.equal(batch["next", "qaf"], following)


@pytest.mark.parametrize("sampler", [TaskBalancedSampler, lambda: CoLearningSampler("push")])
def test_prefetching_one_batch_gives_the_same_batches(dataset, sampler):
    def make(prefetch):
        generator, transform = torch.Generator().manual_seed(0), lw.QAFTransform(PLANS)
        options = dict(sampler=sampler(), transform=transform, generator=generator, batch_size=8)
        return LanguageWorldExperienceReplay(dataset.root, prefetch=prefetch, **options)

    ahead, now = make(1), make(None)
    for _ in range(40):
        assert (ahead.sample() == now.sample()).all()
    assert ahead._prefetch_queue


@pytest.mark.parametrize("make", [lambda: MultiStepTransform(3, 0.9), Reward2GoTransform])
def test_transforms_of_written_rows_are_errors(dataset, make):
    for transform in (make(), Compose(RewardScaling(0.0, 1.0), Compose(make()))):
        with pytest.raises(ValueError, match=f"transform: {type(make()).__name__}"):
            LanguageWorldExperienceReplay(dataset.root, label="executed", transform=transform)


SLICES = functools.partial(SliceSampler, slice_len=4, traj_key=("collector", "traj_ids"))
FRAMES = functools.partial(CatFrames, 3, -1, in_keys=["observation"], out_keys=["frames"])
RESHAPE = functools.partial(BatchSizeTransform, reshape_fn=lambda rows: rows.reshape(-1, 4).refine_names(None, "time"))


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
            own = (rows["observation"] == frame).all(-1)
            assert episode in rows["collector", "traj_ids"][own]


def test_an_inverse_transform_changes_samples(dataset):
    plain, inverse = (open_replay(dataset.root, batch_size=4) for _ in range(2))
    inverse.append_transform(ObservationNorm(0.0, 2.0, in_keys=[], in_keys_inv=["observation"]), invert=True)
    assert not torch.equal(inverse.sample()["observation"], plain.sample()["observation"])


# ---- episodes that end at success


@pytest.fixture(scope="module")
def ending(tmp_path_factory):
    """Episodes that succeed within 90 steps, opened with their ends at success."""
    root = tmp_path_factory.mktemp("ending") / "demos"
    collect(root, episodes_per_task=2, seed=0, noise_scale=0.1, max_steps=90)
    return lambda **options: LanguageWorldExperienceReplay(
        root, label="executed", **{"terminate_on_success": True, **options}
    )


def repeated(replay, episode):
    """Return the states to which an episode's executed actions lead in an environment that ends at success."""
    rows = replay[:]
    actions = rows["action"][episode.start : episode.start + episode.length]
    seed = replay.demonstrations.config.seed
    env = lw.LanguageWorldEnv(episode.task, seed=seed, max_steps=90, terminate_on_success=True)
    state, states = env.reset(episode=episode.episode), []
    for action in actions:
        state = env.step(state.set("action", action.unsqueeze(0)))["next"]
        states.append(state.clone())
        if state["done"].any():
            break
    env.close()
    return torch.cat(states)


def test_episodes_end_as_in_an_environment_that_ends_at_success(ending):
    replay, whole = ending(), ending(terminate_on_success=False)
    rows, episodes = replay[:], replay.demonstrations.episodes
    assert any(episode.success for episode in episodes)
    for number, episode in enumerate(episodes):
        of_episode, expected = rows[rows["collector", "traj_ids"] == number], repeated(whole, episode)
        for key in ("observation", "reward", "success", "done", "terminated", "truncated"):
            assert torch.equal(of_episode["next", key], expected[key]), (episode, key)


def test_n_step_returns_terminate_at_success(ending):
    rows = ending(n_steps=5, gamma=0.99)[:]
    assert torch.equal(rows["next", "terminated"], rows["next", "success"])
    assert (rows["next", "reward"][rows["next", "terminated"]] > 0).all()


# ---- the saved state


KINDS = {
    "plain": {},
    "cut": dict(after_success=3),
    "joined": dict(episodes=2),
    "n steps": dict(label="executed", n_steps=3, gamma=0.9),
}


def open_replay(root, kind="plain", sampler=RandomSampler, seed=0, **options):
    generator = torch.Generator().manual_seed(seed)
    defaults = dict(batch_size=8, sampler=sampler(), generator=generator)
    return LanguageWorldExperienceReplay(root, **{**defaults, **KINDS[kind], **options})


def drawn(replay, batches=4):
    return torch.cat([replay.sample() for _ in range(batches)])


@pytest.mark.parametrize("kind", ["plain", "cut", "joined", "n steps"])
@pytest.mark.parametrize("sampler", [TaskBalancedSampler, RandomSampler, SamplerWithoutReplacement])
@pytest.mark.parametrize("prefetch", [None, 1])
def test_a_restored_buffer_gives_the_same_batches(dataset, tmp_path, kind, sampler, prefetch):
    replay = open_replay(dataset.root, kind, sampler, prefetch=prefetch)
    drawn(replay)
    replay.dumps(tmp_path / "saved")
    assert len(list((tmp_path / "saved").iterdir())) == 1
    expected = drawn(replay, 20)
    again = open_replay(dataset.root, kind, sampler, seed=9, prefetch=prefetch)
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
    names = [path.name for path in folder.iterdir()] + ["prefetch.pkl", "other.pickle", "transform.t"]
    for name in names:
        (folder / name).write_bytes(pickle.dumps(Evil(trace)))
    with pytest.raises(ValueError, match=f"path: '{folder}' holds no"):
        replay.loads(folder)
    assert not trace.exists()


# ---- columns that users add

VARIANTS = {
    "one": lambda a, b: dict(root=a),
    "experts": lambda a, b: dict(root=a, label="expert"),
    "cut": lambda a, b: dict(root=a, after_success=2),
    "joined": lambda a, b: dict(root=[a, b]),
    "chosen": lambda a, b: dict(root=[a, b], episodes=[{"reach": [2, 0]}, {"push": [1]}]),
    "n steps": lambda a, b: dict(root=[a, b], n_steps=3, gamma=0.9),
    "on a device": lambda a, b: dict(root=a, device="cpu"),
}


@pytest.fixture
def opened(dataset, other_dataset):
    def open_variant(variant, **options):
        variant = VARIANTS[variant](dataset.root, other_dataset.root)
        return LanguageWorldExperienceReplay(**{"label": "executed", **variant, **options})

    return open_variant


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("sampler", [RandomSampler, TaskBalancedSampler])
def test_batches_hold_the_column_of_each_row(opened, variant, sampler):
    replay = opened(variant, batch_size=12, sampler=sampler())
    before = replay[:]
    values = torch.arange(len(replay), dtype=torch.float32)[:, None]
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


@pytest.mark.parametrize("variant", ["one", "joined"])
def test_a_column_is_a_copy_without_a_graph(opened, variant):
    replay = opened(variant, batch_size=4)
    values = torch.zeros(len(replay), 1, requires_grad=True)
    replay.add_column("advantage", values * 2)
    assert not replay.sample()["advantage"].requires_grad
    plain = torch.zeros(len(replay), 1)
    replay.add_column("other", plain)
    plain.fill_(7)
    assert (replay[:]["other"] == 0).all()


@pytest.mark.parametrize("variant", ["one", "joined", "n steps"])
def test_a_column_does_not_change_batches_and_state(opened, variant):
    def make():
        generator = torch.Generator().manual_seed(3)
        return opened(variant, batch_size=8, sampler=TaskBalancedSampler(), generator=generator)

    plain, columned = make(), make()
    first = plain.sample(), columned.sample()
    columned.add_column("advantage", torch.arange(len(columned)).float())
    assert (first[0] == first[1]).all()
    state = columned.state_dict()
    assert set(state["_sampler"]) == set(plain.state_dict()["_sampler"])
    expected = [plain.sample()["index"] for _ in range(5)]
    assert all(torch.equal(columned.sample()["index"], index) for index in expected)
    again = make()
    again.add_column("advantage", torch.arange(len(again)).float())
    again.load_state_dict(state)
    for index in expected:
        batch = again.sample()
        assert torch.equal(batch["index"], index)
        assert torch.equal(batch["advantage"], index.float())


def test_values_of_other_rows_are_errors(opened, dataset, other_dataset):
    replay, ahead = opened("joined"), opened("n steps")
    replay.add_column("advantage", torch.zeros(len(ahead), 1), of=ahead)
    turned = LanguageWorldExperienceReplay([other_dataset.root, dataset.root], label="executed")
    assert len(turned) == len(replay)
    with pytest.raises(ValueError, match="of must hold the rows"):
        replay.add_column("other", torch.zeros(len(turned), 1), of=turned)
