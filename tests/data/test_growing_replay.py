"""A buffer of demonstrations that grows by a collector's rows: with TorchRL's collectors, losses and samplers."""

from __future__ import annotations

import pytest
import torch
from torchrl.collectors import Collector
from torchrl.data import RandomSampler, SliceSampler
from torchrl.envs import TransformedEnv
from torchrl.objectives import IQLLoss, SACLoss, SoftUpdate, TD3Loss

import lw_torchrl as lw
from lw_torchrl.data import CoLearningSampler, LanguageWorldExperienceReplay, TaskBalancedSampler

TASKS = ["push", "reach"]
IDS = ("collector", "traj_ids")


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    root = tmp_path_factory.mktemp("made") / "demos"
    lw.collect_demonstrations(TASKS, episodes_per_task=2, root=root, max_steps=30, noise_scale=(0.2,), progress=False)
    return root


@pytest.fixture(scope="module")
def mt10():
    return lw.load_plans("MT10")


def open_replay(root, sampler=None, seed=0, **options):
    return LanguageWorldExperienceReplay(
        root,
        batch_size=40,
        sampler=sampler or CoLearningSampler("grown"),
        generator=torch.Generator().manual_seed(seed),
        **{"label": "executed", "reward": "dense", "grow": 200, **options},
    )


def collect(policy=None, batches=3, reward="dense", frames=40, transform=None, **options):
    env = lw.LanguageWorldEnv(TASKS, num_envs=4, reward=reward, max_steps=15, **options)
    collector = Collector(
        env if transform is None else TransformedEnv(env, transform),
        policy,
        frames_per_batch=frames,
        total_frames=batches * frames,
        auto_register_policy_transforms=False,
    )
    yield from collector
    collector.shutdown()


@pytest.mark.parametrize("kind", ["sac", "td3", "iql"])
def test_collect_extend_sample_and_step(root, mt10, kind):
    replay = open_replay(root, transform=lw.QAFTransform(mt10), n_steps=5, gamma=0.99)
    qvalue = lw.PlanConditionedQValue(mt10, width=16)
    if kind == "td3":
        actor = lw.PlanConditionedActor(mt10, width=16)
        loss = TD3Loss(actor, qvalue, bounds=(-1, 1), num_qvalue_nets=2)
    else:
        actor = lw.PlanConditionedActor(mt10, width=16, distribution="tanh_normal")
        value = lw.PlanConditionedValue(mt10, width=16)
        loss = IQLLoss(actor, qvalue, value) if kind == "iql" else SACLoss(actor, qvalue, num_qvalue_nets=2)
    loss.make_value_estimator(gamma=0.99)
    SoftUpdate(loss, eps=0.99)
    for batch in collect(actor, transform=actor.transform()):
        replay.extend(batch)
        sample = replay.sample()
        assert sample["is_target"].sum() == 20
        assert torch.equal(sample["is_demonstration"], ~sample["is_target"])
        assert sample["task_id"][~sample["is_target"]].unique(return_counts=True)[1].tolist() == [10, 10]
        assert sample["steps_to_next_obs"].max() == 5
        found = loss(sample)
        total = sum(leaf for key, leaf in found.items() if key.startswith("loss"))
        assert total.isfinite()
        total.backward()
    rows = replay[:][120:]
    assert rows["action"].abs().max() <= 1
    asked = lw.QAFTransform(mt10)(rows.select("observation", "task_id", "next"))
    assert torch.equal(asked["next", "qaf"], rows["next", "qaf"]), "of the observation five steps ahead"


def test_rows_that_are_stored_are_what_was_done(root):
    def wild(tensordict):
        return tensordict.set("action", torch.full((4, 4), 3.0))

    replay = open_replay(root)
    (batch,) = collect(wild, batches=1)
    index = replay.extend(batch)
    assert index.shape == batch.shape == (4, 10)
    assert (replay[:][index.reshape(-1)]["action"] == 1).all()
    assert (batch["action"] == 3).all(), "the collector's own stays"


def test_collectors_that_count_from_0_and_a_collector_that_writes_itself(root):
    replay = open_replay(root, RandomSampler())
    for _ in range(2):
        for batch in collect(batches=2, frames=40):
            replay.extend(batch)
    numbers, counts = replay[:][120:][IDS].unique(return_counts=True)
    assert numbers.tolist() == list(range(4, 20))
    assert counts.tolist() == [15] * 4 + [5] * 4 + [15] * 4 + [5] * 4
    for direct in (True, False):
        inside = open_replay(root, RandomSampler())
        env = lw.LanguageWorldEnv(TASKS, num_envs=4, reward="dense", max_steps=15)
        options = dict(frames_per_batch=40, total_frames=80, auto_register_policy_transforms=False)
        collector = Collector(env, None, replay_buffer=inside, extend_buffer=direct, **options)
        for _ in collector:
            pass
        collector.shutdown()
        numbers, counts = inside[:][120:][IDS].unique(return_counts=True)
        assert numbers.tolist() == list(range(4, 12))
        assert sorted(counts.tolist()) == [5] * 4 + [15] * 4


@pytest.mark.parametrize("sampler", [lambda: CoLearningSampler("grown"), TaskBalancedSampler])
def test_a_buffer_saved_between_two_batches_goes_on(root, tmp_path, sampler):
    replay, other = (open_replay(root, sampler(), seed, n_steps=3, gamma=0.9) for seed in range(2))
    for number, batch in enumerate(collect(batches=8)):
        replay.extend(batch.clone())
        if number == 3:
            replay.dumps(tmp_path)
            other.loads(tmp_path)
            assert len(list(tmp_path.iterdir())) == 1
        elif number > 3:
            other.extend(batch.clone())
        for _ in range(3):
            found = replay.sample()
            if number >= 3:
                assert (other.sample() == found).all()
    assert (other[:] == replay[:]).all()


def test_the_other_reward_is_refused_by_name(root):
    (dense,) = collect(batches=1)
    (sparse,) = collect(batches=1, reward="sparse")
    replay = open_replay(root, reward="sparse")
    with pytest.raises(ValueError, match=r"the reward is not the success.* use reward='dense'"):
        replay.extend(dense)
    replay.extend(sparse)
    sparse["next", "success"][0, 0] = True
    sparse["next", "reward"][0, 0] = 1.0
    replay = open_replay(root)
    with pytest.raises(ValueError, match="the demonstrations' is dense; use reward='sparse'"):
        replay.extend(sparse)
    replay.extend(dense)


@pytest.mark.parametrize(("reward", "source"), [("cost", "sparse"), ("dense_cost", "dense")])
def test_rows_get_the_demonstrations_reward_before_n_steps_are_summed(root, tmp_path, reward, source):
    (rows,) = collect(batches=1, reward=source)
    replay = open_replay(root, reward=reward, n_steps=3, gamma=0.9)
    begun = len(replay)
    replay.extend(rows)
    flat = rows.reshape(-1)
    source_reward, success = flat["next", "reward"], flat["next", "success"]
    each = -0.01 * (1 - source_reward) if reward == "cost" else torch.where(success, 0.0, (source_reward - 10) / 100)
    expected = each[0] + 0.9 * each[1] + 0.81 * each[2]
    assert torch.allclose(replay[begun]["next", "reward"], expected, atol=1e-6)
    replay.dumps(tmp_path)
    again = open_replay(root, reward=reward, n_steps=3, gamma=0.9)
    again.loads(tmp_path)
    assert torch.equal(again[begun:]["next", "reward"], replay[begun:]["next", "reward"])
    other = "sparse" if source == "dense" else "dense"
    (wrong,) = collect(batches=1, reward=other)
    if other == "sparse":
        wrong["next", "success"][0, 0], wrong["next", "reward"][0, 0] = True, 1.0
    with pytest.raises(ValueError, match="the reward is"):
        replay.extend(wrong)


def test_a_dense_reward_of_several_steps_is_found_out(root):
    (rows,) = collect(batches=1)
    rows["next", "reward"][0, 0] = 17.0
    with pytest.raises(ValueError, match=r"a reward of 17 is more than a step's, 10.*frame_skip=1"):
        open_replay(root).extend(rows)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        (dict(label="expert"), ValueError, "n_steps, grow and .* need label='executed', got 'expert'"),
        (dict(prefetch=1), ValueError, "prefetch=1 draws batches before the newest rows come"),
        (dict(shared=True), ValueError, "shared=True: a growing buffer cannot be shared"),
        (
            dict(sampler=SliceSampler(slice_len=4, end_key=("next", "done"))),
            ValueError,
            "sampler: a SliceSampler by end",
        ),
    ],
)
def test_what_cannot_go_with_growing_is_refused(root, options, error, message):
    with pytest.raises(error, match=message):
        open_replay(root, **options)


def test_before_anything_has_come_demonstrations_weigh_all_there_is(root):
    """As normalisation wants: with weights of the sum 0.5, means would be half of what they are."""
    replay = open_replay(root)
    weights = replay.sampler.row_weights(replay.storage)
    assert weights.sum().item() == pytest.approx(1.0)
    assert (weights > 0).all()
    replay.extend(next(collect(batches=1)))
    weights = replay.sampler.row_weights(replay.storage)
    here = replay.storage.num_joined
    assert [weights[:here].sum().item(), weights[here:].sum().item()] == pytest.approx([0.5, 0.5])


def test_refused_later_too(root):
    replay = open_replay(root)
    with pytest.raises(ValueError, match="sampler: a SliceSampler by end"):
        replay.set_sampler(SliceSampler(slice_len=4, end_key=("next", "done")))
    with pytest.raises(RuntimeError, match="cannot be shared between processes"):
        replay.share()
    still = LanguageWorldExperienceReplay(root, label="executed", batch_size=4)
    with pytest.raises(RuntimeError, match="doesn't allow writing"):
        still.extend(replay[:])


def test_what_is_shown_is_what_a_collector_gives_too(root):
    replay = open_replay(root)
    later = ("observation", "task_id", "success", "done", "terminated", "truncated", "reward")
    here = ("observation", "task_id", "episode", "action", IDS)
    assert replay.storage.keys() == [*here, *(("next", key) for key in later), "is_demonstration"]
    assert replay.tasks == tuple(TASKS)
    assert replay.demonstrations.num_steps == len(replay) == 120
