"""Policies that collect datasets: scripted skills with wrong segments, random actions, trained policies, functions."""

import json

import pytest
import torch
from collecting import PLANS, SEED, STEPS, collect, interrupt_after, same_rows, trained, tree
from commands import fails
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict.nn import TensorDictModule
from torchrl.envs.utils import ExplorationType, set_exploration_type

import lw_torchrl as lw
from lw_torchrl._util.reproducibility import episode_generator
from lw_torchrl.data import BEHAVIOURS, Behaviour, CollectConfig, DatasetError
from lw_torchrl.data.collection_policy import SegmentActor, policy_fingerprint, segment_plans
from lw_torchrl.data.dataset import load_rows, read_metadata
from lw_torchrl.language.skill_program import SkillProgram
from lw_torchrl.language.tasks import task_id
from lw_torchrl.modules.policy import with_plans
from lw_torchrl.training import BehavioralCloningConfig, BehavioralCloningTrainer
from lw_torchrl.training.checkpoint import demonstrated_tasks, demonstration_seeds


@pytest.fixture(scope="module")
def datasets(tmp_path_factory):
    """A dataset of each behaviour, by name."""
    root = tmp_path_factory.mktemp("behaviours")
    return {name: collect(root / name, policy=name) for name in BEHAVIOURS}


@pytest.mark.parametrize("name", BEHAVIOURS)
def test_rows_depend_neither_on_num_envs_nor_on_other_tasks(datasets, name, tmp_path):
    narrow = collect(tmp_path / "narrow", policy=name, num_envs=5 if name == "expert" else 2)
    assert tree(narrow.root) == tree(datasets[name].root)
    alone = collect(tmp_path / "alone", policy=name, tasks="reach", num_envs=1)
    rows = load_rows(datasets[name])
    together = rows[rows["task_id"] == task_id("reach")].exclude("collector")
    assert (together == load_rows(alone).exclude("collector")).all()


def test_metadata_describe_the_behaviour(datasets):
    for name in {*BEHAVIOURS} - {"expert"}:
        config = read_metadata(datasets[name].root).config
        assert config.behaviour == name
        assert config.policy.acts == BEHAVIOURS[name]
        assert config.policy.fingerprint == segment_plans(("push", "reach")).fingerprint
        assert CollectConfig.from_json(json.loads(json.dumps(config.to_json()))) == config


def segments(flags):
    """Return the lengths of the runs of equal rows of (T, ...)."""
    changes = (flags[1:] != flags[:-1]).reshape(len(flags) - 1, -1).any(-1).nonzero().flatten() + 1
    return torch.diff(torch.cat([torch.tensor([0]), changes, torch.tensor([len(flags)])])).tolist()


def acting(behaviour):
    actor = SegmentActor(behaviour, segment_plans(["reach"]), SEED, 500)
    actor._begin(1)
    return actor


@given(st.floats(0, 1), st.sampled_from(["skill", "action"]), *map(st.integers, (1, 0, 0), (30, 30, 2**40)))
@settings(max_examples=30, deadline=None)
def test_segments_have_the_given_lengths_and_probability(right, otherwise, shortest, more, episode):
    behaviour = Behaviour("any", right=right, otherwise=otherwise, shortest=shortest, longest=shortest + more)
    actor = acting(behaviour)
    actor._draw(0, task_id("reach"), episode)
    lengths = segments(actor._random_action[0])
    assert sum(lengths) == 500
    assert all(shortest <= length <= shortest + more for length in lengths[:-1])
    assert lengths[-1] <= shortest + more
    assert actor._random_action.abs().max() <= 1
    starts = torch.tensor([0, *lengths[:-1]]).cumsum(0)
    for start, length in zip(starts.tolist(), lengths, strict=True):
        for drawn in (actor._right, actor._skill):
            assert len(drawn[0, start : start + length].unique()) == 1
    draws = episode_generator("segments", "reach", SEED, episode)  # the order of the draws is part of the data
    assert lengths[0] == draws.integers(shortest, shortest + more + 1, -(-500 // shortest))[0]


@pytest.mark.parametrize(("name", "right"), [("noisy-60", 0.6), ("noisy-30", 0.3), ("wrong", 0.0), ("scripted", 1.0)])
def test_the_share_of_right_segments(name, right):
    actor, share = acting(BEHAVIOURS[name]), 0.0
    for episode in range(300):
        actor._draw(0, task_id("reach"), episode)
        share += actor._right[0].double().mean().item()
    mean = share / 300
    assert abs(mean - right) < 0.02
    assert (mean == right) or 0 < right < 1


def test_scripted_acts_as_the_scripted_skill_actor(tmp_path):
    tasks = ("button-press-topdown", "reach")
    options = dict(tasks=tasks, noise_scale=0.0, max_steps=40)
    dataset = collect(tmp_path / "demos", policy="scripted", **options)
    actor = lw.ScriptedSkillActor(segment_plans(tasks))
    assert same_rows(dataset, collect(tmp_path / "actor", policy=actor, behaviour="other", **options))


def test_wrong_acts_by_skills_of_the_plan(tmp_path):
    """Each action is that of a skill of the plan in the same state."""
    dataset = collect(tmp_path / "demos", tasks="push", policy="wrong", noise_scale=0.0, max_steps=60)
    rows, plan = load_rows(dataset), segment_plans(["push"])["push"]
    program = SkillProgram({plan.definition: [step.skill for step in plan.steps]})
    actions = program(rows["observation"].clone(), rows["task_id"].clone())
    assert (actions == rows["unclipped_action"].unsqueeze(1)).all(-1).any(-1).all()


def test_redrawing_stops_if_nothing_succeeds(tmp_path, monkeypatch):
    monkeypatch.setattr("lw_torchrl.data.collect._MAX_ATTEMPTS", 3)
    with pytest.raises(RuntimeError, match=r"only 0 of 3 .*redraw_failures=False"):
        collect(tmp_path / "demos", tasks="push", policy="random", redraw_failures=True, episodes_per_task=1)


def test_a_checkpoint_records_seeds_and_tasks_of_its_demonstrations(tmp_path, datasets, capsys):
    tiny = collect(tmp_path / "tiny", tasks="reach", policy=trained(), behaviour="tiny", seed=77)
    roots = [datasets["noisy-60"].root, tiny.root]
    cases = [(roots, {SEED, 77}, {"push", "reach"}), (roots[1], {77}, {"reach"})]
    for number, (root, seeds, tasks) in enumerate(cases):
        options = dict(sampler=lw.TaskBalancedSampler(), transform=lw.QAFTransform(PLANS))
        replay = lw.LanguageWorldExperienceReplay(root, label="executed", **options)
        path = tmp_path / f"{number}.safetensors"
        config = BehavioralCloningConfig(steps=1, batch_size=8)
        BehavioralCloningTrainer(trained(), replay, config, checkpoint=path, progress=False).train()
        assert demonstration_seeds(path) == seeds
        assert demonstrated_tasks(path) == tasks
        for seed in seeds:
            assert "is the seed of the demonstrations" in fails(capsys, "evaluate", path, "--seed", seed)


@pytest.mark.parametrize("kind", ["plan", "description"])
def test_a_policy_acts_as_in_an_evaluation(tmp_path, kind):
    actor = trained(kind).train()
    options = dict(noise_scale=0.1, gripper_noise_factor=1.0, noise_hold=1)
    dataset = collect(tmp_path / "demos", policy=actor, behaviour="tiny", num_envs=3, **options)
    assert actor.training, "its mode does not change"
    how = dict(episodes_per_task=3, seed=SEED, noise_scale=0.1, max_steps=STEPS)
    result = lw.evaluate(actor, tasks=("push", "reach"), record_actions=True, progress=False, **how)
    rows = load_rows(dataset)
    for info, episode in zip(dataset.episodes, result.episodes, strict=True):
        assert (info.task, info.episode) == (episode.task, episode.episode)
        assert torch.equal(rows["action"][info.start : info.start + info.length], episode.actions)
    assert dataset.config.behaviour == "tiny"


def test_a_policy_with_a_distribution_acts_without_exploring(tmp_path):
    actor = trained().stochastic("tanh_normal").train()
    dataset = collect(tmp_path / "one", policy=actor, behaviour="tiny")
    torch.manual_seed(99)
    assert tree(collect(tmp_path / "other", policy=actor, behaviour="tiny", num_envs=2).root) == tree(dataset.root)
    rows = load_rows(dataset)
    state = rows.select("observation", "task_id").clone()
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        actor.eval()(lw.QAFTransform(PLANS)(state))
    assert torch.allclose(state["action"], rows["expert_action"], atol=1e-5)


def test_only_the_same_policy_resumes_an_interrupted_collection(tmp_path, monkeypatch):
    root, actor = tmp_path / "demos", trained()
    whole = collect(tmp_path / "whole", policy=actor, behaviour="tiny")
    with monkeypatch.context() as patch:
        interrupt_after(patch, 2)
        with pytest.raises(KeyboardInterrupt):
            collect(root, policy=actor, behaviour="tiny", num_envs=2)
    before, changed = tree(root), trained()
    next(changed.parameters()).data += 1e-3
    for other in (trained(seed=1), trained(squash=False), changed):
        with pytest.raises(DatasetError, match=r"policy.fingerprint"):
            collect(root, policy=other, behaviour="tiny")
    with pytest.raises(DatasetError, match=r"policy.name"):
        collect(root, policy=actor, behaviour="other")
    assert tree(root) == before
    assert tree(collect(root, policy=actor, behaviour="tiny").root) == tree(whole.root)


def test_a_module_and_a_function_collect_the_same_rows(tmp_path):
    """A TensorDictModule of any network, a function, and a module with plans, which reads their truth."""

    class Tanh(torch.nn.PReLU):  # without sums of products, whose last bit may depend on the number of rows
        def forward(self, observation):
            return (observation[..., :4] * self.weight).tanh()

    network = Tanh()
    module = TensorDictModule(network, in_keys=["observation"], out_keys=["action"])
    by_module = collect(tmp_path / "module", policy=module, behaviour="mine")
    by_function = collect(tmp_path / "function", policy=lambda rows: module(rows), behaviour="mine", num_envs=2)
    assert same_rows(by_module, by_function)
    rows = load_rows(by_module)
    torch.testing.assert_close(rows["unclipped_action"], network(rows["observation"]).detach())
    assert by_module.config.policy.fingerprint == policy_fingerprint(module)
    assert by_function.config.policy == Behaviour("mine", "policy")
    network.weight.data *= 2
    with pytest.raises(DatasetError, match="another configuration"):
        collect(tmp_path / "module", policy=module, behaviour="mine")

    class Planned(TensorDictModule):
        plans = PLANS

    act = lambda observation, qaf: observation[..., :4].tanh() * qaf[..., :1]  # noqa: E731
    planned = Planned(act, in_keys=["observation", "qaf"], out_keys=["action"])
    dataset = collect(tmp_path / "planned", policy=planned, behaviour="planned")
    rows = lw.QAFTransform(PLANS)(load_rows(dataset).select("observation", "task_id", "expert_action").clone())
    torch.testing.assert_close(rows["expert_action"], rows["observation"][:, :4].tanh() * rows["qaf"][:, :1])


def test_a_fingerprint_depends_on_all_parts_of_a_policy():
    base = policy_fingerprint(trained())
    assert policy_fingerprint(trained()) == base
    others = [
        trained(seed=1),
        trained(squash=False),
        trained(features=lw.modules.ObservationFeatures("raw")),
        trained("description"),
        with_plans(trained(), {**PLANS, "reach": lw.ConditionalPlan("reach", PLANS["reach"].steps[:1])}),
        trained(text_encoder=lambda texts: torch.randn(len(texts), 384, generator=torch.Generator())),
        trained().bfloat16(),
    ]
    fingerprints = [base, *map(policy_fingerprint, others)]
    assert len(set(fingerprints)) == len(fingerprints)
