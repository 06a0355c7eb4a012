"""SkillMixer: one latent for each different skill, mixed by attention."""

import pytest
import torch
from small_actors import PLANS, letters, make_rows
from torch import nn

import lw_torchrl as lw
from lw_torchrl.language.roles import role_vectors
from lw_torchrl.modules import SkillMixer


def test_steps_of_one_kind_have_one_latent_in_every_task():
    """Canonical steps are encoded by verb and manner: no text is read."""

    def refuse(texts):
        pytest.fail(f"a text encoder was called for {texts}")

    plans = lw.canonical_plans(lw.load_plans("MT50"))
    mixer = SkillMixer(plans, text_encoder=refuse)
    assert mixer.text_vectors is None
    for task in ("push", "coffee-pull", "shelf-place"):
        vectors = mixer.vectors[mixer.index[mixer.tables.index.row(task)]]
        for number, vector in enumerate(role_vectors([step.role for step in plans[task].steps])):
            assert torch.equal(vectors[number] > 0, torch.tensor(vector) > 0)
    first = [mixer.index[mixer.tables.index.row(task), 0].item() for task in ("push", "coffee-pull")]
    assert first[0] == first[1]


@pytest.mark.parametrize("encoder", [nn.Linear(384, 7), nn.LazyLinear(7), nn.Sequential(nn.LazyLinear(7), nn.ReLU())])
def test_any_module_can_be_the_skill_encoder(encoder):
    mixer = SkillMixer(PLANS, encoder)
    assert (mixer.latent_size, mixer.encoder) == (7, encoder)
    mixer(make_rows(4).set("skill_weights", torch.rand(4, PLANS.num_steps)))["skill_latent"].sum().backward()
    assert all(parameter.grad is not None for parameter in encoder.parameters())


def test_text_encoder_is_called_once_for_the_different_skills():
    calls = []

    def encode(texts):
        calls.append(tuple(texts))
        return letters(texts).double()

    mixer = SkillMixer(PLANS, text_encoder=encode)
    assert calls == [PLANS.skills]
    assert (mixer.vectors.dtype, mixer.vectors.shape[1]) == (torch.float32, 5)
    torch.testing.assert_close(mixer.vectors.square().mean(-1), torch.ones(len(PLANS.skills)))
