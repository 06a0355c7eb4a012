"""Who acts in a dataset: plans with scripted skills, sound and spoilt, chance; and what replays make of it."""

from __future__ import annotations

import json

import pytest
import torch
from collecting import PLANS, SEED, collect, interrupt_after, same_rows, trained, tree
from hypothesis import given, settings
from hypothesis import strategies as st

import lw_torchrl as lw
from lw_torchrl._util.reproducibility import episode_generator
from lw_torchrl.data import BEHAVIOURS, Behaviour, CollectConfig, DatasetError, collect
from lw_torchrl.data.collection_policy import SegmentActor, segment_plans
from lw_torchrl.data.dataset import load_rows, read_metadata
from lw_torchrl.envs.episodes import run_episodes
from lw_torchrl.language.tasks import task_id
from lw_torchrl.training import BehavioralCloningConfig, BehavioralCloningTrainer
from lw_torchrl.training.checkpoint import demonstrated_tasks, demonstration_seeds

OTHERS = [name for name in BEHAVIOURS if name != "expert"]


# ---- who acts by pieces


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A dataset of each behaviour."""
    root = tmp_path_factory.mktemp("behaviours")
    return {name: collect(root / name, policy=name) for name in OTHERS}


@pytest.mark.parametrize("name", OTHERS)
def test_a_dataset_depends_on_neither_the_number_of_environments_nor_the_tasks_beside(made, name, tmp_path):
    assert same_rows(made[name], collect(tmp_path / "narrow", policy=name, num_envs=2))
    alone = collect(tmp_path / "alone", policy=name, tasks="reach", num_envs=1)
    rows = load_rows(made[name])
    beside = rows[rows["task_id"] == task_id("reach")].exclude("collector")
    assert (beside == load_rows(alone).exclude("collector")).all()


@pytest.mark.parametrize("name", ["spoilt-30", "random"])
def test_nor_on_interruptions(made, name, tmp_path, monkeypatch):
    root = tmp_path / "stopped"
    for episodes in (1, 2):
        with monkeypatch.context() as patch:
            interrupt_after(patch, episodes)
            with pytest.raises(KeyboardInterrupt):
                collect(root, policy=name, num_envs=2)
    assert tree(collect(root, policy=name, num_envs=3).root) == tree(made[name].root)


def test_the_metadata_say_who_acted(made):
    for name, one in made.items():
        found = read_metadata(one.root).config
        assert found.behaviour == name
        assert found.policy.acts == BEHAVIOURS[name]
        assert found.policy.fingerprint == segment_plans(("push", "reach")).fingerprint
        assert CollectConfig.from_json(json.loads(json.dumps(found.to_json()))) == found


def pieces(flags):
    """The lengths of the runs of equal rows of (T, ...)."""
    changes = (flags[1:] != flags[:-1]).reshape(len(flags) - 1, -1).any(-1).nonzero().flatten() + 1
    return torch.diff(torch.cat([torch.tensor([0]), changes, torch.tensor([len(flags)])])).tolist()


def acting(behaviour, tasks=("reach",), max_steps=500):
    return SegmentActor(behaviour, segment_plans(tasks), SEED, max_steps)


@given(
    right=st.floats(0.0, 1.0),
    otherwise=st.sampled_from(["skill", "action"]),
    shortest=st.integers(1, 30),
    more=st.integers(0, 30),
    episode=st.integers(0, 2**40),
)
@settings(max_examples=30, deadline=None)
def test_pieces_are_as_long_and_as_often_right_as_said(right, otherwise, shortest, more, episode):
    how = Behaviour("any", right=right, otherwise=otherwise, shortest=shortest, longest=shortest + more)
    actor = acting(how)
    actor._begin(1)
    actor._draw(0, task_id("reach"), episode)
    held = pieces(actor._held[0])
    assert sum(held) == 500
    assert all(shortest <= length <= shortest + more for length in held[:-1])
    assert held[-1] <= shortest + more
    assert actor._held.abs().max() <= 1
    starts = torch.tensor([0, *held[:-1]]).cumsum(0)
    for start, length in zip(starts.tolist(), held, strict=True):
        for drawn in (actor._right, actor._skill):
            assert len(drawn[0, start : start + length].unique()) == 1
    draws = episode_generator("segments", "reach", SEED, episode)  # the order of the draws is part of the data
    assert held[0] == draws.integers(shortest, shortest + more + 1, -(-500 // shortest))[0]


@pytest.mark.parametrize(("name", "right"), [("spoilt-60", 0.6), ("spoilt-30", 0.3), ("wrong", 0.0), ("scripted", 1.0)])
def test_the_share_of_right_pieces(name, right):
    actor = acting(BEHAVIOURS[name])
    actor._begin(1)
    shares = []
    for episode in range(300):
        actor._draw(0, task_id("reach"), episode)
        shares.append(actor._right[0].double().mean())
    mean = torch.stack(shares).mean()
    assert abs(mean - right) < 0.02
    assert (mean == right) or 0 < right < 1


def recorded(actor, tasks, policy=None, steps=40, episodes=2):
    """The actions of a plain run of episodes."""
    env = lw.LanguageWorldEnv(tasks, num_envs=4, seed=SEED, max_steps=steps)
    from torchrl.envs import TransformedEnv

    wrapped = TransformedEnv(env, lw.QAFTransform(segment_plans(tasks)))
    keys = ["action", "observation"]
    found = run_episodes(wrapped, actor, {task: range(episodes) for task in tasks}, keys=keys)
    done = {(one.task, one.episode): one.steps for one in found}
    wrapped.close()
    return done


def test_all_right_is_the_scripted_skill_actor(tmp_path):
    tasks = ("button-press-topdown", "reach")
    ours = recorded(lw.ScriptedSkillActor(segment_plans(tasks)), tasks)
    made = collect(tmp_path / "demos", tasks=tasks, policy="scripted", noise_scale=0.0, max_steps=40)
    rows = load_rows(made)
    for info in made.episodes:
        if info.episode < 2:
            span = slice(info.start, info.start + info.length)
            assert torch.equal(rows["action"][span], ours[info.task, info.episode]["action"])
            assert torch.equal(rows["observation"][span], ours[info.task, info.episode]["observation"])


def test_wrong_does_what_skills_of_the_plan_do(tmp_path):
    """Each action is one of the plan's skills', in the state that it was taken in."""
    from lw_torchrl.language.skill_program import SkillProgram

    made = collect(tmp_path / "demos", tasks="push", policy="wrong", noise_scale=0.0, max_steps=60)
    rows, plan = load_rows(made), segment_plans(["push"])["push"]
    offered = SkillProgram({plan.definition: [step.skill for step in plan.steps]})(
        rows["observation"].clone(), rows["task_id"].clone()
    )
    assert (offered == rows["unclipped_action"].unsqueeze(1)).all(-1).any(-1).all()


# ---- what replays make of them


@pytest.mark.parametrize(
    ("was", "now", "message"),
    [
        ("expert", "scripted", r"policy.kind \('expert', now 'segments'\), policy.name \('expert', now 'scripted'\)"),
        ("scripted", "expert", r"policy.name \('scripted', now 'expert'\)"),
        ("spoilt-30", "spoilt-60", r"policy.name \('spoilt-30', now 'spoilt-60'\), policy.right \(0.3, now 0.6\)"),
    ],
)
def test_a_dataset_of_another_behaviour_is_refused_with_what_differs(tmp_path, was, now, message):
    made = collect(tmp_path / "demos", tasks="reach", episodes_per_task=1, policy=was)
    before = tree(made.root)
    with pytest.raises(DatasetError, match=message):
        collect(made.root, tasks="reach", episodes_per_task=1, policy=now)
    assert tree(made.root) == before


def test_redrawing_with_others_than_the_expert(tmp_path, monkeypatch):
    options = dict(tasks="reach", policy="wrong", redraw_failures=True, episodes_per_task=2, max_steps=31)
    made = collect(tmp_path / "a", noise_scale=0.0, **options)
    assert all(one.success for one in made.episodes)
    assert made.attempts["reach"] > 2, "the test wants failures"
    assert tree(collect(tmp_path / "b", noise_scale=0.0, num_envs=1, **options).root) == tree(made.root)
    monkeypatch.setattr(missing_episodes, "_MAX_ATTEMPTS", 3)
    with pytest.raises(RuntimeError, match=r"only 0 of 3 episodes of 'random' succeeded.*redraw_failures=False"):
        collect(tmp_path / "c", tasks="push", policy="random", redraw_failures=True, episodes_per_task=1)


@pytest.mark.parametrize("label", ["expert", "unclipped"])
def test_the_experts_label_is_refused_where_another_acted(made, label):
    with pytest.raises(
        ValueError, match=f"label='{label}' needs an expert's actions, but this dataset was collected by 'random'"
    ):
        lw.LanguageWorldExperienceReplay(made["random"].root, label=label)


def test_rows_say_who_acted(made):
    names = ("wrong", "scripted", "random")
    replay = lw.LanguageWorldExperienceReplay([made[name].root for name in names], label="executed")
    assert replay.behaviours == ("random", "scripted", "wrong")
    size = made["wrong"].num_steps
    assert replay[:]["behaviour"].tolist() == [2] * size + [1] * size + [0] * size


def test_one_label_of_two_behaviours_is_refused(tmp_path, made):
    one = collect(tmp_path / "one", policy=trained(), behaviour="tiny")
    other = collect(tmp_path / "other", policy=trained(seed=1), behaviour="tiny")
    with pytest.raises(ValueError, match="'tiny' names different behaviours"):
        lw.LanguageWorldExperienceReplay([one.root, other.root], label="executed")
    stated = json.loads((other.root / "metadata.json").read_text())
    stated["config"]["policy"]["name"] = "second"
    (other.root / "metadata.json").write_text(json.dumps(stated))
    both = lw.LanguageWorldExperienceReplay([one.root, other.root], label="executed")
    assert both.behaviours == ("second", "tiny")
    alone = collect(tmp_path / "reach", tasks="reach", policy="scripted")  # other plans, the same behaviour
    lw.LanguageWorldExperienceReplay([made["scripted"].root, alone.root], label="executed")


def test_a_policy_trained_on_such_data_says_which_seeds_it_saw(tmp_path, made, capsys):
    from commands import fails

    tiny = collect(tmp_path / "tiny", tasks="reach", policy=trained(), behaviour="tiny", seed=77)
    roots = [made["spoilt-60"].root, tiny.root]
    for number, (root, seeds, tasks) in enumerate(
        [(roots, {SEED, 77}, {"push", "reach"}), (roots[0], {SEED}, {"push", "reach"}), (roots[1], {77}, {"reach"})]
    ):
        replay = lw.LanguageWorldExperienceReplay(
            root, label="executed", sampler=lw.TaskBalancedSampler(), transform=lw.QAFTransform(PLANS)
        )
        path = tmp_path / f"{number}.safetensors"
        config = BehavioralCloningConfig(steps=1, batch_size=8)
        BehavioralCloningTrainer(trained(), replay, config, checkpoint=path, progress=False).train()
        assert demonstration_seeds(path) == seeds
        assert demonstrated_tasks(path) == tasks
        for seed in seeds:
            assert "is the seed of the demonstrations" in fails(capsys, "evaluate", path, "--seed", seed)
