"""Extensions in a user's file: a method, an evaluator, a relation, a task and an engine, used together."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential, dispatch
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import TransformedEnv

import lw_torchrl as lw
from lw_torchrl.envs import EngineStep
from lw_torchrl.language.relations import RELATIONS, Comparison
from lw_torchrl.language.skills import ScriptedSkill
from lw_torchrl.language.task_index import TaskIndex
from lw_torchrl.language.tasks import task_ids
from lw_torchrl.modules import METHODS, MLPDecoder, ObservationFeatures, SkillEncoder, make_policy
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
    """A point that moves by at most a centimetre, and a block."""

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


class LearnedTaskActor(TensorDictModuleBase):
    """A policy with a learned vector for each task."""

    def __init__(self, tasks, size=8, width=32):
        super().__init__()
        self.tasks, self.config = tuple(tasks), {"tasks": list(tasks), "size": size, "width": width}
        self.in_keys, self.out_keys = ["observation", "task_id"], ["action"]
        self.index = TaskIndex(task_ids(self.tasks))
        self.vectors = nn.Embedding(len(self.tasks), size)
        self.features = ObservationFeatures()
        self.net = MLPDecoder(width=width, depth=1)
        self(observation=torch.zeros(1, 39), task_id=torch.tensor([lw.task_id(self.tasks[0])]))  # the decoder is lazy

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict):
        rows = self.index.rows(tensordict["task_id"], "tasks unknown to this actor")
        features = self.features(tensordict["observation"])
        return tensordict.set("action", self.net(torch.cat((self.vectors.weight[rows], features), -1)))


class NearnessEvaluator(lw.QueryEvaluator):
    """Learns the distance at which the first condition ends and the second begins."""

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
    """Rows of the plan's scripted skills in the engine."""
    env = TransformedEnv(
        lw.LanguageWorldEnv(
            [plan.definition for plan in plans.values()], num_envs=8, engine=PointEngine, max_steps=STEPS
        ),
        lw.QAFTransform(plans),
    )
    rows = env.rollout(STEPS, lw.ScriptedSkillActor(plans, skills=SKILLS)).reshape(-1)
    env.close()
    assert rows["next", "success"].any()
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(len(rows)))
    buffer.extend(rows.select("observation", "task_id", "qaf", "action"))
    return buffer


def trained(actor, replay, path):
    config = lw.BehavioralCloningConfig(steps=300, batch_size=64, learning_rate=3e-3)
    trainer = lw.BehavioralCloningTrainer(actor, replay, config, checkpoint=path, progress=False)
    assert trainer.train() < 0.5
    return actor


def make(kind, plans):
    torch.manual_seed(0)
    if kind == "learned":
        return make_policy("learned", plans, width=32)
    actor = small(plans)
    return TensorDictSequential(NearnessEvaluator(plans), actor) if kind == "evaluator" else actor


def small(plans):
    parts = {"skill_encoder": SkillEncoder(4, width=8), "decoder": MLPDecoder(width=32, depth=1)}
    return lw.PlanConditionedActor(plans, text_encoder=letters, **parts)


@pytest.mark.parametrize("kind", ["plan", "learned", "evaluator"])
def test_extensions_are_trained_saved_loaded_evaluated_and_recorded(kind, plans, replay, tmp_path, monkeypatch):
    monkeypatch.setitem(METHODS, "learned", lambda plans, **options: LearnedTaskActor([*plans], **options))
    path = tmp_path / "policy.safetensors"
    actor = trained(make(kind, plans), replay, path)
    loaded = lw.load_actor(path, text_encoder=letters)
    state = loaded.state_dict()
    assert [*actor.state_dict()] == [*state]
    assert all(torch.equal(value, state[name]) for name, value in actor.state_dict().items())
    definitions = [plan.definition for plan in plans.values()]
    run = dict(seed=1_000, engine=PointEngine, max_steps=STEPS)
    result = lw.evaluate(loaded, tasks=definitions, episodes_per_task=10, noise_scale=0.0, **run)
    assert result.success_once["touch-the-block"] >= 0.8
    episodes = run_recorded(loaded, definitions, **run)
    write_recording(tmp_path / "rollout.rrd", episodes, lw.modules.plans_of(loaded), tasks=definitions)
    assert (tmp_path / "rollout.rrd").stat().st_size > 10_000
    if kind == "evaluator":
        assert actor[0].radius.item() != pytest.approx(0.1)
        assert "qaf" not in actor.in_keys


def test_missing_relation_is_named(plans, tmp_path, monkeypatch):
    lw.save_actor(small(plans), tmp_path / "policy.safetensors")
    monkeypatch.delitem(RELATIONS, "beside")
    with pytest.raises(ValueError, match=r"'beside'.*; import the module that registers your relations first"):
        lw.load_actor(tmp_path / "policy.safetensors", text_encoder=letters)


def test_custom_task_is_saved_with_its_policy(plans, tmp_path):
    lw.save_actor(small(plans), tmp_path / "policy.safetensors")
    loaded = lw.load_actor(tmp_path / "policy.safetensors", text_encoder=letters)
    assert loaded.plans.fingerprint == plans.fingerprint
    assert loaded.plans["touch-the-block"].definition.object_names == ("robot's gripper", "block")
    lw.save_actor(
        lw.modules.DescriptorConditionedActor([plan.definition for plan in plans.values()], text_encoder=letters),
        tmp_path / "dc.safetensors",
    )
    assert lw.load_actor(tmp_path / "dc.safetensors", text_encoder=letters).tasks == ("touch-the-block",)


def test_other_modules_act_and_train(plans, replay):
    torch.manual_seed(0)
    module = TensorDictModule(nn.Linear(39, 4), in_keys=["observation"], out_keys=["action"])
    lw.BehavioralCloningTrainer(
        module, replay, lw.BehavioralCloningConfig(steps=5, batch_size=8), progress=False
    ).train()
    definitions = [plan.definition for plan in plans.values()]
    result = lw.evaluate(module, tasks=definitions, episodes_per_task=2, seed=1, engine=PointEngine, max_steps=5)
    assert json.loads(json.dumps(result.config))["tasks"] == ["touch-the-block"]
