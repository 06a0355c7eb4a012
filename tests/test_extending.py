"""What a user adds from a file of their own, nothing of ours changed: a way of conditioning, an evaluator, a relation,
a task, an engine. Together they are trained, saved, loaded, evaluated and recorded."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import TransformedEnv

import lw_torchrl as lw
from lw_torchrl.envs import EngineStep
from lw_torchrl.language.relations import RELATIONS, Comparison
from lw_torchrl.language.skills import ScriptedSkill
from lw_torchrl.language.task_index import TaskIndex
from lw_torchrl.language.tasks import task_ids
from lw_torchrl.modules import EVALUATORS, METHODS, POLICIES, Method, ObservationFeatures, make_policy
from lw_torchrl.modules.networks import ActionHead
from lw_torchrl.record.rollouts import run_recorded, write_recording

STEPS = 40
TASK = """
[touch-the-block]
description = "Touch the block."
objects.block = "obs[4:7]"
"""
PLAN = """
def touch_the_block(robot):
    if check("the gripper is not beside the block"):
        robot.go("to the block")
    if check("the gripper is beside the block"):
        robot.stay("at the block")
"""
SKILLS = {
    text: ScriptedSkill(text, "block", gain=(gain,) * 3)
    for text, gain in (("go to the block", 10.0), ("stay at the block", 0.0))
}


class PointEngine:
    """A hand without a body that moves by a centimetre at most, and a block."""

    def __init__(self, rows, *, reward, num_threads):
        self.state = np.zeros((len(rows), 39))

    def reset(self, rows, seeds):
        for row, seed in zip(rows, seeds, strict=True):
            self.state[row] = 0.0
            self.state[row, :7] = np.random.default_rng(seed).uniform(-0.1, 0.1, 7)
            self.state[row, 36:39] = self.state[row, 4:7]
        return self.state[list(rows)].copy()

    def step(self, action, active):
        self.state[active, :3] += 0.01 * action[active, :3]
        success = (np.linalg.norm(self.state[:, :3] - self.state[:, 4:7], axis=1) < 0.05) & active
        return EngineStep(self.state.copy(), success.astype(float), success, np.zeros(len(success), bool))

    def close(self):
        pass


class LearnedTaskActor(lw.Policy):
    """Conditioned on a vector of each task that is learned."""

    def __init__(self, tasks, size=8, width=32):
        super().__init__()
        self.tasks, self.config = tuple(tasks), {"size": size, "width": width}
        self.in_keys, self.out_keys = ["observation", "task_id"], ["action"]
        self.index = TaskIndex(task_ids(self.tasks))
        self.vectors = nn.Embedding(len(self.tasks), size)
        self.features = ObservationFeatures()
        self.head = ActionHead(size + self.features.width, width, 1)

    def prepare(self, tensordict):
        observation, task_id = self.read(tensordict)
        return self.index.rows(task_id, "tasks unknown to this actor"), self.features(observation)

    def act(self, rows, seen):
        return (self.head(torch.cat((self.vectors.weight[rows], seen), -1)),)

    def describe(self):
        return super().describe() | {"tasks": list(self.tasks)}

    @classmethod
    def from_description(cls, found, text_encoder=None):
        return cls(found["tasks"], **found["options"])


class NearnessEvaluator(lw.QueryEvaluator):
    """Learns at what distance the first condition ends and the second begins."""

    def __init__(self, plans, sharpness=50.0):
        super().__init__(plans)
        self.config = {"sharpness": sharpness}
        self.radius = nn.Parameter(torch.tensor(0.1))

    def logits(self, observation, task_id):
        away = (observation[..., :3] - observation[..., 4:7]).norm(dim=-1) - self.radius
        return torch.stack((away, -away), -1) * self.config["sharpness"]


def letters(texts):
    return torch.tensor([[float(text.count(letter)) for letter in "aeioust"] for text in texts])


@pytest.fixture
def plans(tmp_path, monkeypatch):
    monkeypatch.setitem(RELATIONS, "beside", (Comparison("xyz", "<", 0.05),))
    (tmp_path / "tasks.toml").write_text(TASK)
    (tmp_path / "touch-the-block.plan").write_text(PLAN)
    return lw.load_plans(tmp_path / "touch-the-block.plan", tasks=lw.load_tasks(tmp_path / "tasks.toml"))


@pytest.fixture
def replay(plans):
    """What the plan's scripts do in our engine."""
    env = TransformedEnv(
        lw.LanguageWorldEnv(
            [plan.definition for plan in plans.values()], num_envs=8, engine=PointEngine, max_steps=STEPS
        ),
        lw.QAFTransform(plans),
    )
    rows = env.rollout(STEPS, lw.ScriptedSkillActor(plans, skills=SKILLS)).reshape(-1)
    env.close()
    assert rows["next", "success"].any()
    found = TensorDictReplayBuffer(storage=LazyTensorStorage(len(rows)))
    found.extend(rows.select("observation", "task_id", "qaf", "action"))
    return found


def trained(actor, replay, path):
    config = lw.BehavioralCloningConfig(steps=300, batch_size=64, learning_rate=3e-3)
    trainer = lw.BehavioralCloningTrainer(actor, replay, config, checkpoint=path, progress=False)
    assert trainer.train() < 0.5
    return actor


def made(kind, plans):
    torch.manual_seed(0)
    small = dict(latent_size=4, width=32, depth=1, encoder_width=8, text_encoder=letters)
    if kind == "evaluator":
        return lw.PlanConditionedActor(plans, evaluator=NearnessEvaluator(plans), **small)
    if kind == "learned":
        return make_policy("learned", plans, width=32)
    return lw.PlanConditionedActor(plans, **small)


@pytest.mark.parametrize("kind", ["plan", "learned", "evaluator"])
def test_it_is_trained_saved_loaded_evaluated_and_recorded(kind, plans, replay, tmp_path, monkeypatch):
    monkeypatch.setitem(POLICIES, "LearnedTaskActor", LearnedTaskActor)
    monkeypatch.setitem(METHODS, "learned", Method("LearnedTaskActor"))
    monkeypatch.setitem(EVALUATORS, "NearnessEvaluator", NearnessEvaluator)
    path = tmp_path / "policy.safetensors"
    actor = trained(made(kind, plans), replay, path)
    loaded = lw.load_actor(path, text_encoder=letters)
    for (name, ours), (other, found) in zip(actor.state_dict().items(), loaded.state_dict().items(), strict=True):
        assert name == other
        assert torch.equal(ours, found)
    definitions = [plan.definition for plan in plans.values()]
    result = lw.evaluate(
        loaded,
        tasks=definitions,
        episodes_per_task=10,
        seed=1_000,
        engine=PointEngine,
        max_steps=STEPS,
        noise_scale=0.0,
    )
    assert result.success_once["touch-the-block"] >= 0.8
    episodes = run_recorded(loaded, definitions, seed=1_000, engine=PointEngine, max_steps=STEPS)
    write_recording(tmp_path / "rollout.rrd", episodes, loaded.plans, tasks=definitions)
    assert (tmp_path / "rollout.rrd").stat().st_size > 10_000
    if kind == "evaluator":
        assert actor.evaluator.radius.item() != pytest.approx(0.1)
        assert "qaf" not in actor.in_keys


def test_a_kind_that_is_not_there_is_named(plans, replay, tmp_path, monkeypatch):
    monkeypatch.setitem(POLICIES, "LearnedTaskActor", LearnedTaskActor)
    lw.save_actor(LearnedTaskActor(plans), tmp_path / "policy.safetensors")
    monkeypatch.delitem(POLICIES, "LearnedTaskActor")
    with pytest.raises(ValueError, match=r"'LearnedTaskActor' is not known here.*--import test_extending"):
        lw.load_actor(tmp_path / "policy.safetensors")
    monkeypatch.setattr(LearnedTaskActor, "__module__", "__main__")
    monkeypatch.setitem(POLICIES, "LearnedTaskActor", LearnedTaskActor)
    lw.save_actor(LearnedTaskActor(plans), tmp_path / "policy.safetensors")
    monkeypatch.delitem(POLICIES, "LearnedTaskActor")
    with pytest.raises(ValueError, match="is of a script; register it in a module"):
        lw.load_actor(tmp_path / "policy.safetensors")


def test_a_relation_that_is_not_there_is_told_of(plans, tmp_path, monkeypatch):
    lw.save_actor(lw.PlanConditionedActor(plans, text_encoder=letters, width=8), tmp_path / "policy.safetensors")
    monkeypatch.delitem(RELATIONS, "beside")
    with pytest.raises(ValueError, match=r"'beside'.*; import the module that registers your relations first"):
        lw.load_actor(tmp_path / "policy.safetensors", text_encoder=letters)


def test_an_own_task_travels_with_its_policy(plans, tmp_path):
    lw.save_actor(lw.PlanConditionedActor(plans, text_encoder=letters, width=8), tmp_path / "policy.safetensors")
    loaded = lw.load_actor(tmp_path / "policy.safetensors", text_encoder=letters)
    assert loaded.plans.fingerprint == plans.fingerprint
    assert loaded.plans["touch-the-block"].definition.object_names == ("robot's gripper", "block")
    lw.save_actor(
        lw.DescriptorConditionedActor([plan.definition for plan in plans.values()], text_encoder=letters, width=8),
        tmp_path / "dc.safetensors",
    )
    assert lw.load_actor(tmp_path / "dc.safetensors", text_encoder=letters).tasks == ("touch-the-block",)


def test_a_foreign_module_acts_and_trains_too(plans, replay):
    torch.manual_seed(0)
    module = TensorDictModule(nn.Linear(39, 4), in_keys=["observation"], out_keys=["action"])
    lw.BehavioralCloningTrainer(
        module, replay, lw.BehavioralCloningConfig(steps=5, batch_size=8), progress=False
    ).train()
    definitions = [plan.definition for plan in plans.values()]
    result = lw.evaluate(module, tasks=definitions, episodes_per_task=2, seed=1, engine=PointEngine, max_steps=5)
    assert json.loads(json.dumps(result.config))["tasks"] == ["touch-the-block"]
