"""Which episodes are kept, against an oracle by hand, and what shows what is left."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from collecting import collect
from hypothesis import given, settings
from hypothesis import strategies as st
from torchrl.data import RandomSampler, SliceSampler

import lw_torchrl as lw
from lw_torchrl.data import CoLearningSampler, CollectConfig, Demonstrations, EpisodeFilter, TaskBalancedSampler
from lw_torchrl.data.collection_policy import behaviour_of
from lw_torchrl.data.dataset import EpisodeInfo
from lw_torchrl.data.rewards import REWARDS, episode_returns

TASKS = ("push", "reach")
STEPS = 34
BEHAVIOURS = {name: behaviour_of(name, TASKS) for name in ("expert", "random", "wrong")}
CONFIGS = {
    (each, name): CollectConfig(TASKS, each, 0, policy=BEHAVIOURS[name]) for each in range(5)[1:] for name in BEHAVIOURS
}


# ---- against an oracle


@st.composite
def joined(draw):
    """Descriptions of one to three datasets, and of each episode its return and rows."""
    parts, returns = [], []
    for number in range(draw(st.integers(1, 3))):
        each = draw(st.integers(1, 4))
        config = CONFIGS[each, draw(st.sampled_from(list(BEHAVIOURS)))]
        episodes, found = [], []
        for task in TASKS:
            for index in range(each):
                success = draw(st.booleans())
                rows = draw(st.integers(1, 3))
                episodes.append(EpisodeInfo(task, index, 0, rows, success, 1 if success else None, 0))
                found.append((draw(st.sampled_from([-1.0, 0.0, 0.5, 2.0])), float(rows)))
        parts.append(Demonstrations(Path(str(number)), config, {}, {}, tuple(episodes), {}))
        returns.append(torch.tensor(found, dtype=torch.float64))
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
    """The kept (part, number): written anew, by hand."""
    kept, everything = [], []
    for place, part in enumerate(parts):
        for number, episode in enumerate(part.episodes):
            earned, rows = returns[place][number].tolist()
            everything.append((episode.task, -earned, rows, place, number))
            if success is not None and episode.success != success:
                continue
            if least_return is not None and earned < least_return:
                continue
            if behaviours is not None and part.config.policy.name not in behaviours:
                continue
            kept.append((episode.task, -earned, rows, place, number))
    chosen = set()
    for task in TASKS:
        ours = sorted(row for row in kept if row[0] == task)
        share = best
        if not ours:
            if else_best is None:
                return None
            ours, share = sorted(row for row in everything if row[0] == task), else_best
        size = len(ours) if share is None else max(1, round(share * len(ours)))
        chosen |= {row[3:] for row in ours[:size]}
    return chosen


@given(joined(), filters)
@settings(max_examples=150, deadline=None)
def test_what_is_kept_is_what_the_conditions_say(found, options):
    parts, returns = found
    labels = {part.config.behaviour for part in parts}
    keep = EpisodeFilter(**options)
    if set(options["behaviours"] or ()) - labels:
        with pytest.raises(ValueError, match="keep: behaviours must be one of"):
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


def test_of_equal_returns_the_shorter_and_then_the_earlier_are_best():
    config = CollectConfig(("reach",), 4, 0)
    episodes = tuple(EpisodeInfo("reach", n, 0, 9, True, 1, 0) for n in range(4))
    part = Demonstrations(Path(), config, {}, {}, episodes, {})
    returns = torch.tensor([[1.0, 9], [2.0, 9], [2.0, 5], [1.0, 9]], dtype=torch.float64)
    kept = [EpisodeFilter(best=b).choose([part], [returns])[0].episodes for b in (0.25, 0.5, 0.75, 1.0)]
    assert [[e.episode for e in one] for one in kept] == [[2], [1, 2], [0, 1, 2], [0, 1, 2, 3]]


# ---- of datasets


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A script, whose reach succeeds but once not, and chance, which does nowhere."""
    root = tmp_path_factory.mktemp("filters")
    options = dict(max_steps=STEPS, noise_scale=0.0, episodes_per_task=5)
    found = {name: collect(root / name, policy=name, **options) for name in ("scripted", "random")}
    assert {e.success for e in found["scripted"].episodes if e.task == "reach"} == {True, False}
    assert not any(e.success for e in found["random"].episodes)
    return found


def opened(made, *names, **options):
    roots = [made[name].root for name in names]
    return lw.LanguageWorldExperienceReplay(roots if len(names) > 1 else roots[0], label="executed", **options)


def shown(replay):
    parts = getattr(replay.demonstrations, "parts", (replay.demonstrations,))
    return [[(e.task, e.episode) for e in part.episodes] for part in parts]


@pytest.mark.parametrize("reward", list(REWARDS))
@pytest.mark.parametrize("ends", [dict(), dict(after_success=3), dict(terminate_on_success=True)])
def test_returns_are_the_sums_of_the_rows_shown(made, reward, ends):
    whole = opened(made, "scripted", "random", reward=reward, **ends)
    rows = whole[:]
    returns = []
    for number in range(len(whole.demonstrations.episodes)):
        own = rows["next", "reward"][rows["collector", "traj_ids"] == number]
        returns.append(sum(own.flatten().tolist()))
    tasks = [e.task for e in whole.demonstrations.episodes]
    least = min(max(r for r, of in zip(returns, tasks, strict=True) if of == task) for task in TASKS)
    kept = opened(made, "scripted", "random", reward=reward, keep=EpisodeFilter(least_return=least - 1e-9), **ends)
    expected = [number for number, total in enumerate(returns) if total >= least - 1e-9]
    assert len(expected) > 0
    assert kept[:]["collector", "traj_ids"].unique().tolist() == expected
    best = opened(made, "scripted", "random", reward=reward, keep=EpisodeFilter(best=0.01), **ends)
    for task in TASKS:
        (one,) = [n for n in best[:]["collector", "traj_ids"].unique().tolist() if tasks[n] == task]
        assert returns[one] >= max(r for r, of in zip(returns, tasks, strict=True) if of == task) - 1e-9


def test_returns_are_summed_in_double_precision_over_each_episode():
    reward = torch.tensor([[1.0], [2.0], [4.0], [8.0]])
    assert episode_returns(reward, [1, 3]).tolist() == [[1.0, 1.0], [14.0, 3.0]]
    assert episode_returns(reward[:0], []).shape == (0, 2)
    many = torch.full((10_000_000, 1), 0.1)
    assert float(episode_returns(many, [len(many)])[0, 0]) == pytest.approx(
        float(many[0, 0].double()) * len(many), 1e-12
    )


def test_success_and_behaviours_choose_across_parts(made):
    both = opened(made, "scripted", "random", keep=EpisodeFilter(behaviours=("random",)))
    assert shown(both)[0] == []
    assert len(both) == made["random"].num_steps
    assert both.behaviours == ("random", "scripted")
    assert both[:]["behaviour"].unique().tolist() == [0]
    failed = opened(made, "scripted", "random", keep=EpisodeFilter(success=False))
    assert all(not e.success for e in failed.demonstrations.episodes)
    alone = opened(made, "scripted", episodes={"reach": 5}, keep=EpisodeFilter(success=True))
    assert shown(alone) == [[(e.task, e.episode) for e in made["scripted"].episodes if e.task == "reach" and e.success]]


def test_nothing_left_of_a_task_is_an_error(made):
    with pytest.raises(ValueError, match=r"keep: EpisodeFilter\(success=True.*leaves no episode of push"):
        opened(made, "random", "scripted", keep=EpisodeFilter(success=True))
    with pytest.raises(ValueError, match=r"keep: behaviours must be one of 'scripted', got 'scribted'; did you mean"):
        opened(made, "scripted", keep=EpisodeFilter(behaviours=("scribted",)))


def test_filters_see_episodes_as_they_are_shown(made):
    """Cut at the first success, the quickest has the highest cost_return; whole, the dense reward goes on."""
    wanted = [e for e in made["scripted"].episodes if e.task == "reach" and e.success]
    quickest = min(wanted, key=lambda e: e.first_success)
    options = dict(episodes={"reach": 5}, reward="cost", keep=EpisodeFilter(best=0.2))
    for ends in (dict(terminate_on_success=True), dict(after_success=0)):
        replay = opened(made, "scripted", **options, **ends)
        assert shown(replay) == [[("reach", quickest.episode)]]
        assert len(replay) == quickest.first_success
        assert replay[:]["next", "reward"][-1] == 0
        assert torch.equal(replay[-1:]["next", "terminated"], torch.tensor([["terminate_on_success" in ends]]))


EMPTY = dict(keep=EpisodeFilter(behaviours=("scripted",)))  # leaves nothing of the second part


@pytest.mark.parametrize(
    "sampler",
    [
        lambda: None,
        RandomSampler,
        TaskBalancedSampler,
        lambda: CoLearningSampler("reach"),
        lambda: SliceSampler(slice_len=4, traj_key=("collector", "traj_ids")),
    ],
)
@pytest.mark.parametrize("order", [("scripted", "random"), ("random", "scripted")])
@pytest.mark.parametrize("options", [dict(), dict(n_steps=3, gamma=0.9), dict(terminate_on_success=True)])
def test_a_part_left_without_episodes_is_sampled_as_if_it_were_not_there(made, sampler, order, options):
    def batches(*names, keep=None):
        replay = opened(
            made,
            *names,
            keep=keep,
            sampler=sampler(),
            batch_size=8,
            generator=torch.Generator().manual_seed(0),
            **options,
        )
        torch.manual_seed(0)  # a SliceSampler draws from the global generator
        found = [replay.sample() for _ in range(5)]
        return len(replay), torch.cat(found).exclude("index", ("collector", "traj_ids"), "behaviour", "dataset")

    rows, alone = batches("scripted", keep=EpisodeFilter(behaviours=("scripted",)))
    joined_rows, joined = batches(*order, **EMPTY)
    assert joined_rows == rows
    assert (joined == alone).all()


def test_a_trainer_of_another_choice_is_told_apart(made):
    """What a policy file says of its data names the chosen episodes."""
    from lw_torchrl.training.minibatches import describe_data

    one, other = (opened(made, "scripted", episodes={"reach": 5}, keep=EpisodeFilter(success=s)) for s in (True, False))
    assert describe_data(one) != describe_data(other)
    assert describe_data(one)["parts"] == describe_data(other)["parts"]
