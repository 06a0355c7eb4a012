"""SkillMixer: one latent for each different skill, mixed by attention."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from small_actors import PLANS, letters, make_rows
from torch import nn

import lw_torchrl as lw
from lw_torchrl.language.roles import role_vectors
from lw_torchrl.language.text import encode_texts
from lw_torchrl.modules import PlanAttention, SkillEncoder, SkillMixer


def weighted(*shape, plans=PLANS, seed=0):
    """Rows with random attention."""
    rows = make_rows(*shape, plans=plans, seed=seed)
    rows["qaf"] = torch.rand(*shape, plans.num_steps, generator=torch.Generator().manual_seed(seed))
    return PlanAttention(plans)(rows)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**31))
def test_mixed_latents_by_hand(seed):
    rows = weighted(3, seed=seed)
    output = MIXER(rows.clone())["skill_latent"]
    for row in range(3):
        steps = PLANS[lw.MT50[rows["task_id"][row]]].steps
        vectors = encode_texts([step.skill for step in steps])
        latents = MIXER.encoder(vectors / vectors.square().mean(-1, keepdim=True).sqrt())  # root mean square 1
        torch.testing.assert_close(output[row], rows["skill_weights"][row, : len(steps)] @ latents)


torch.manual_seed(0)
MIXER = SkillMixer(PLANS, SkillEncoder(6, width=12))


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
    mixer(weighted(4))["skill_latent"].sum().backward()
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
