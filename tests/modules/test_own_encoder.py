"""An encoder of the user's makes deterministic actors, stochastic ones and critics, and files hold them."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch
from torch import nn

import lw_torchrl as lw
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.text import TEXT_DIMENSION
from lw_torchrl.modules import (
    ENCODERS,
    ConditionedActor,
    DescriptorEncoder,
    Encoder,
    Encoding,
    ObservationFeatures,
    PlanEncoder,
    QValue,
    make_policy,
)  # fmt: skip

FOLDER = Path(__file__).parent.parent.parent / "examples" / "extending"
PLANS = lw.load_plans("MT10")


@pytest.fixture
def own(monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))
    before = dict(ENCODERS.data)
    import my_method

    yield my_method.TaskVectors
    ENCODERS.data = before
    sys.modules.pop("my_method")


def states():
    torch.manual_seed(1)
    return {"observation": torch.rand(4, 39), "task_id": torch.tensor([lw.task_id(task) for task in lw.MT10[:4]])}


def saved(actor, path, **options):
    lw.save_actor(actor, path)
    return lw.load_actor(path, **options)


@pytest.mark.parametrize("distribution", [None, "normal"])
def test_it_is_kept_in_a_file(own, tmp_path, distribution):
    actor = ConditionedActor(own(["push", "reach"], size=3, feature_noise=0.0), width=8, distribution=distribution)
    again = saved(actor, tmp_path / "policy.safetensors")
    assert (again.tasks, again.config, again.encoder.config) == (actor.tasks, actor.config, actor.encoder.config)
    state = states() | {"task_id": torch.full((4,), lw.task_id("push"))}
    assert torch.equal(actor(**state), again(**state)) if distribution is None else actor(**state)[0].shape == (4, 4)


def test_a_trained_one_gets_a_distribution_without_noise(own):
    actor = ConditionedActor(own(PLANS, feature_noise=0.3), width=8).eval()
    drawn = actor.stochastic(init_std=0.2)
    assert drawn.encoder.features.noise == 0.0
    assert actor.encoder.features.noise == 0.3
    state = states()
    assert torch.allclose(actor(**state), drawn(**state)[0], atol=1e-6)


def test_a_critic_is_built_on_it(own):
    assert QValue(own(PLANS))(**states(), action=torch.zeros(4, 4)).shape == (4, 1)


def test_the_name_of_its_class_is_a_method_with_its_options(own):
    actor = make_policy("TaskVectors", PLANS, size=3, width=8)
    assert isinstance(actor, ConditionedActor)
    assert (actor.encoder.latent_size, actor.config["width"], actor.tasks) == (3, 8, lw.MT10)
    with pytest.raises(ValueError, match="option of TaskVectors must be one of 'size', 'feature_noise', got 'sise'"):
        make_policy("TaskVectors", PLANS, sise=3)


@pytest.mark.parametrize("make", [PlanEncoder, DescriptorEncoder])
def test_ours_make_actors_too(tmp_path, make):
    actor = ConditionedActor(make(PLANS, feature_noise=0.1), width=8).eval()
    again = saved(actor, tmp_path / "policy.safetensors")
    state = states() | ({"qaf": torch.zeros(4, 6, dtype=torch.bool)} if make is PlanEncoder else {})
    ours, found = actor(**state), again(**state)
    assert torch.equal(ours[0] if make is PlanEncoder else ours, found[0] if make is PlanEncoder else found)
    assert type(again.encoder) is make


def test_its_own_tasks_and_texts_travel(tmp_path):
    task = lw.Task("touch", "Touch the puck.", lw.TASKS["push"].objects)

    def encode(texts):
        return torch.ones(len(texts), TEXT_DIMENSION)

    actor = ConditionedActor(DescriptorEncoder([task], text_encoder=encode), width=8)
    again = saved(actor, tmp_path / "policy.safetensors", text_encoder=encode)
    assert again.definition("touch").description == "Touch the puck."
    with pytest.raises(ValueError, match="text_encoder"):
        lw.load_actor(
            tmp_path / "policy.safetensors", text_encoder=lambda texts: torch.zeros(len(texts), TEXT_DIMENSION)
        )


def test_what_is_no_encoder_and_options_of_one_are_refused():
    with pytest.raises(TypeError, match=r"about must be an Encoder, got Plans.*PlanEncoder\(plans\)"):
        ConditionedActor(PLANS)
    with pytest.raises(TypeError, match=r"feature_noise: give it to the encoder, PlanEncoder\(..., feature_noise=\)"):
        ConditionedActor(PlanEncoder(PLANS), feature_noise=0.1)


class Holding(Encoder):
    """The share of a plan's conditions that hold, and, with ``by_skill``, a vector for each skill."""

    plan_options = True

    def __init__(self, plans, *, by_skill=False):
        super().__init__()
        self.plans, self.tasks, self.layout = plans, tuple(plans), plans.layout
        self.config, self.latent_size = {"by_skill": by_skill}, 3
        self.in_keys, self.out_keys = ["observation", "qaf"], ["encoding"]
        self.features = ObservationFeatures("differences", 0.0, self.layout)
        self.vectors = nn.Embedding(len(plans.skills) if by_skill else 1, 3)

    def prepare(self, tensordict):
        observation, qaf = self.read(tensordict)
        return qaf.float(), self.features(observation)

    def encode(self, holds, seen):
        weights = holds / holds.sum(-1, keepdim=True).clamp(min=1.0)
        return Encoding(holds.mean(-1, keepdim=True) * self.vectors.weight[0], seen, weights)


def test_one_for_plans_carries_out_others_on_the_same_weights():
    reach = Plans({"reach": PLANS["reach"]})
    actor = ConditionedActor(Holding(reach), width=8)
    actor.fit_normalization(torch.rand(50, 39))
    other = actor.with_plans(PLANS)
    assert (type(other), other.plans, other.tasks) == (ConditionedActor, PLANS, lw.MT10)
    assert {id(one) for one in actor.parameters()} == {id(one) for one in other.parameters()}
    assert other.encoder.features.mean is actor.encoder.features.mean
    with pytest.raises(ValueError, match=r"weights of Holding are those of its own plans: .*vectors.weight"):
        ConditionedActor(Holding(reach, by_skill=True)).with_plans(PLANS)
    with pytest.raises(TypeError, match="conditioned on descriptions"):
        DescriptorEncoder(PLANS).with_plans(PLANS)
