"""Selected episodes against an oracle written by hand, the rows that buffers show of them, and their rewards."""

from functools import partial
from itertools import product
from pathlib import Path

import pytest
import torch
from collecting import TASKS, collect
from hypothesis import given, settings
from hypothesis import strategies as st
from torchrl.data import RandomSampler, SliceSampler

import lw_torchrl as lw
from lw_torchrl.data import CoLearningSampler, CollectConfig, Demonstrations, EpisodeFilter, TaskBalancedSampler
from lw_torchrl.data.collection_policy import behaviour_of
from lw_torchrl.data.dataset import EpisodeInfo, load_rows
from lw_torchrl.data.rewards import REWARDS, episode_returns
from lw_torchrl.training.minibatches import describe_data

STEPS = 34
SLICES = partial(SliceSampler, slice_len=4, traj_key=("collector", "traj_ids"))
SAMPLERS = [lambda: None, RandomSampler, TaskBalancedSampler, lambda: CoLearningSampler("reach"), SLICES]
BEHAVIOURS = {name: behaviour_of(name, TASKS) for name in ("expert", "random", "wrong")}
CONFIGS = {
    (each, name): CollectConfig(TASKS, each, 0, policy=BEHAVIOURS[name]) for each in range(5)[1:] for name in BEHAVIOURS
}


@st.composite
def joined(draw):
    """Descriptions of one to three datasets, and the return and the rows of each episode."""
    parts, returns = [], []
    for number in range(draw(st.integers(1, 3))):
        each = draw(st.integers(1, 4))
        config = CONFIGS[each, draw(st.sampled_from(list(BEHAVIOURS)))]
        episodes, totals = [], []
        for task, index in product(TASKS, range(each)):
            success, rows = draw(st.booleans()), draw(st.integers(1, 3))
            episodes.append(EpisodeInfo(task, index, 0, rows, success, 1 if success else None, 0))
            totals.append((draw(st.sampled_from([-1.0, 0.0, 0.5, 2.0])), float(rows)))
        parts.append(Demonstrations(Path(str(number)), config, {}, {}, tuple(episodes), {}))
        returns.append(torch.tensor(totals, dtype=torch.float64))
    return parts, returns


filters = st.builds(
    dict,
    success=st.sampled_from([None, True, False]),
    least_return=st.sampled_from([None, -5, 0.0, 0.5]),
    best=st.sampled_from([None, 0.01, 0.25, 0.5, 1.0]),
    behaviours=st.sampled_from([None, ("expert",), ("expert", "random"), ("wrong",)]),
    else_best=st.sampled_from([None, 0.3, 1.0]),
)


def oracle(parts, returns, success, least_return, best, behaviours, else_best):
    """Return the kept (part, number) pairs, computed in another way."""
    kept, everything = [], []
    for place, part in enumerate(parts):
        for number, episode in enumerate(part.episodes):
            total, rows = returns[place][number].tolist()
            everything.append((episode.task, -total, rows, place, number))
            if success is not None and episode.success != success:
                continue
            if least_return is not None and total < least_return:
                continue
            if behaviours is not None and part.config.policy.name not in behaviours:
                continue
            kept.append((episode.task, -total, rows, place, number))
    chosen = set()
    for task in TASKS:
        of_task, share = sorted(row for row in kept if row[0] == task), best
        if not of_task:
            if else_best is None:
                return None
            of_task, share = sorted(row for row in everything if row[0] == task), else_best
        size = len(of_task) if share is None else max(1, round(share * len(of_task)))
        chosen |= {row[3:] for row in of_task[:size]}
    return chosen


@given(joined(), filters)
@settings(max_examples=50, deadline=None)
def test_filters_keep_what_the_oracle_keeps(described, options):
    parts, returns = described
    labels = {part.config.behaviour for part in parts}
    keep = EpisodeFilter(**options)
    if set(options["behaviours"] or ()) - labels:
        with pytest.raises(ValueError, match="keep: behaviours"):
            keep.choose(parts, returns)
        return
    expected = oracle(parts, returns, **options)
    if expected is None:
        with pytest.raises(ValueError, match=r"leaves no episode of (push|reach)"):
            keep.choose(parts, returns)
        return
    left = keep.choose(parts, returns)
    assert [part.config for part in left] == [part.config for part in parts]
    for place, (part, before) in enumerate(zip(left, parts, strict=True)):
        assert part.episodes == tuple(e for n, e in enumerate(before.episodes) if (place, n) in expected)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Scripted skills, which fail once at reach, and random actions, which never succeed."""
    root = tmp_path_factory.mktemp("filters")
    options = dict(max_steps=STEPS, noise_scale=0.0, episodes_per_task=5)
    datasets = {name: collect(root / name, policy=name, **options) for name in ("scripted", "random")}
    assert {e.success for e in datasets["scripted"].episodes if e.task == "reach"} == {True, False}
    assert not any(e.success for e in datasets["random"].episodes)
    return datasets


def opened(made, *names, **options):
    roots = [made[name].root for name in names]
    return lw.LanguageWorldExperienceReplay(roots if len(names) > 1 else roots[0], label="executed", **options)


def shown(replay):
    parts = getattr(replay.demonstrations, "parts", (replay.demonstrations,))
    return [[(e.task, e.episode) for e in part.episodes] for part in parts]


def test_returns_are_summed_in_double_precision_over_each_episode():
    reward = torch.tensor([[1.0], [2.0], [4.0], [8.0]])
    assert episode_returns(reward, [1, 3]).tolist() == [[1.0, 1.0], [14.0, 3.0]]
    assert episode_returns(reward[:0], []).shape == (0, 2)
    many = torch.full((10_000_000, 1), 0.1)
    total = float(episode_returns(many, [len(many)])[0, 0])
    assert total == pytest.approx(float(many[0, 0].double()) * len(many), 1e-12)


def test_success_and_behaviours_select_across_parts(made):
    both = opened(made, "scripted", "random", keep=EpisodeFilter(behaviours=("random",)))
    assert shown(both)[0] == []
    assert len(both) == made["random"].num_steps
    assert both.behaviours == ("random", "scripted")
    assert both[:]["behaviour"].unique().tolist() == [0]
    failed = opened(made, "scripted", "random", keep=EpisodeFilter(success=False))
    assert all(not e.success for e in failed.demonstrations.episodes)
    alone = opened(made, "scripted", episodes={"reach": 5}, keep=EpisodeFilter(success=True))
    assert shown(alone) == [[(e.task, e.episode) for e in made["scripted"].episodes if e.task == "reach" and e.success]]


def test_filters_see_episodes_as_they_are_shown(made):
    """Cut at the first success, the quickest episode has the highest return of costs."""
    successes = [e for e in made["scripted"].episodes if e.task == "reach" and e.success]
    quickest = min(successes, key=lambda e: e.first_success)
    options = dict(episodes={"reach": 5}, reward="cost", keep=EpisodeFilter(best=0.2))
    for ends in (dict(terminate_on_success=True), dict(after_success=0)):
        replay = opened(made, "scripted", **options, **ends)
        assert shown(replay) == [[("reach", quickest.episode)]]
        assert len(replay) == quickest.first_success
        assert replay[:]["next", "reward"][-1] == 0
        assert torch.equal(replay[-1:]["next", "terminated"], torch.tensor([["terminate_on_success" in ends]]))


@pytest.mark.parametrize("sampler", SAMPLERS)
@pytest.mark.parametrize("order", [("scripted", "random"), ("random", "scripted")])
@pytest.mark.parametrize("options", [dict(), dict(n_steps=3, gamma=0.9), dict(terminate_on_success=True)])
def test_a_part_without_kept_episodes_does_not_change_batches(made, sampler, order, options):
    def batches(*names):
        how = dict(keep=keep, sampler=sampler(), batch_size=8, generator=torch.Generator().manual_seed(0))
        replay = opened(made, *names, **how, **options)
        torch.manual_seed(0)  # a SliceSampler draws from the global generator
        rows = torch.cat([replay.sample() for _ in range(5)])
        return len(replay), rows.exclude("index", ("collector", "traj_ids"), "behaviour", "dataset")

    keep = EpisodeFilter(behaviours=("scripted",))  # leaves nothing of the other part
    rows, alone = batches("scripted")
    joined_rows, joined = batches(*order)
    assert joined_rows == rows
    assert (joined == alone).all()


def test_the_description_of_the_data_names_the_episodes(made):
    one, other = (opened(made, "scripted", episodes={"reach": 5}, keep=EpisodeFilter(success=s)) for s in (True, False))
    assert describe_data(one) != describe_data(other)
    assert describe_data(one)["parts"] == describe_data(other)["parts"]


@pytest.mark.parametrize("name", list(REWARDS))
@pytest.mark.parametrize("ends", [dict(), dict(after_success=2), dict(terminate_on_success=True)])
def test_rewards_are_those_computed_by_hand(made, name, ends):
    dataset = made["scripted"]
    rows, shown_rows = load_rows(dataset), opened(made, "scripted", reward=name, **ends)[:]
    kept = [
        info.start + step
        for info in dataset.episodes
        for step in range(info.length)
        if not ends or not info.success or step < info.first_success + ends.get("after_success", 0)
    ]
    success, dense = (rows["next", key][kept].float() for key in ("success", "reward_dense"))
    by_hand = {"sparse": success, "dense": dense, "cost": (success - 1) / 100, "dense_cost": (dense - 10) / 100}
    by_hand["dense_cost"][success == 1] = 0
    torch.testing.assert_close(shown_rows["next", "reward"], by_hand[name], atol=1e-6, rtol=0)
