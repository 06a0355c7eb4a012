"""Terms on skills' latents: against sums written out by hand, and in both trainers."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn.functional import normalize

import lw_torchrl as lw
from lw_torchrl.modules import PlanEncoder

KINDS = ("consistency", "contrastive")

PLANS = lw.load_plans("MT10")
SMALL = dict(width=16, depth=1, latent_size=5, encoder_width=8)


def make_actor(seed=0, plans=PLANS, **options):
    torch.manual_seed(seed)
    return lw.PlanConditionedActor(plans, **{**SMALL, **options})


def term(network, kind):
    return lw.objectives.SkillLatentLoss(network, kind)()["loss_latents"]


def cosine(one, other):
    dot = sum(a * b for a, b in zip(one, other, strict=True))
    return dot / math.sqrt(sum(a * a for a in one)) / math.sqrt(sum(b * b for b in other))


def by_hand(encoder, kind):
    latents, texts = encoder.latents().double().tolist(), encoder.text_vectors.double().tolist()
    skills = range(len(encoder.skills))
    if kind == "consistency":
        pairs = [(i, j) for i in skills for j in skills if i < j]
        return sum((cosine(latents[i], latents[j]) - cosine(texts[i], texts[j])) ** 2 for i, j in pairs) / len(pairs)
    total = 0.0
    for i in skills:
        near = [math.exp(cosine(latents[i], latents[j]) / 0.1) for j in skills]
        total -= math.log(near[i] / sum(near))
    return total / len(skills)


@pytest.mark.parametrize("options", [{}, {"distribution": "normal"}, {"encoder_depth": 0}])
@pytest.mark.parametrize("kind", KINDS)
def test_it_is_what_is_written_by_hand(kind, options):
    actor = make_actor(**options)
    assert term(actor, kind).item() == pytest.approx(by_hand(actor.encoder, kind), rel=1e-4)
    assert torch.equal(term(actor.encoder, kind), term(actor, kind))


def test_of_latents_that_lie_as_the_texts_do_there_is_nothing_to_mend():
    encoder = PlanEncoder(PLANS, latent_size=384, encoder_depth=0)
    with torch.no_grad():
        encoder.texts[0].weight.copy_(torch.eye(384) * 3)  # turned and scaled they lie as before
        encoder.texts[0].bias.zero_()
    assert term(encoder, "consistency") < 1e-10


def test_of_latents_that_are_all_alike_contrast_is_the_logarithm_of_their_number():
    actor = make_actor()
    with torch.no_grad():
        actor.encoder.texts[-1].weight.zero_()
    assert term(actor, "contrastive").item() == pytest.approx(math.log(len(actor.encoder.skills)), rel=1e-5)


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 1000), factor=st.sampled_from([0.25, 4.0]))
def test_the_latents_length_changes_nothing(seed, factor):
    actor = make_actor(seed)
    before = [term(actor, kind).item() for kind in KINDS]
    with torch.no_grad():
        actor.encoder.texts[-1].weight *= factor
        actor.encoder.texts[-1].bias *= factor
    assert [term(actor, kind).item() for kind in KINDS] == pytest.approx(before, rel=1e-4)
    assert min(before) >= 0


@pytest.mark.parametrize("kind", KINDS)
def test_it_trains_the_texts_encoder_of_the_actor_itself(kind):
    actor = make_actor()
    loss = lw.objectives.SkillLatentLoss(actor, kind)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    before = term(actor, kind).item()
    for _ in range(100):
        optimizer.zero_grad()
        loss()["loss_latents"].backward()
        optimizer.step()
    assert all(p.grad.abs().sum() > 0 for p in actor.encoder.texts.parameters())
    assert all(p.grad is None for p in actor.head.parameters())
    assert by_hand(actor.encoder, kind) < before / 2


def test_consistency_makes_latents_alike_as_texts_are():
    actor = make_actor(latent_size=32, encoder_width=64)
    loss = lw.objectives.SkillLatentLoss(actor)

    def likeness():
        both = (normalize(x, dim=-1) for x in (loss.encoder.latents(), loss.encoder.text_vectors))
        above = torch.triu_indices(*[len(loss.encoder.skills)] * 2, 1).unbind()
        return torch.corrcoef(torch.stack([(x @ x.T)[above] for x in both]))[0, 1].item()

    before = likeness()
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    for _ in range(200):
        optimizer.zero_grad()
        loss()["loss_latents"].backward()
        optimizer.step()
    assert likeness() > max(before, 0.9)


@pytest.mark.filterwarnings(  # what PyTorch warns of when it compiles
    "ignore:torch._dynamo.config.inline_inbuilt_nn_modules:FutureWarning",
    "ignore:.*LeafSpec:FutureWarning",
    "ignore:.*torch.jit:DeprecationWarning",
)
@pytest.mark.parametrize("kind", ["contrastive", pytest.param("consistency", marks=pytest.mark.slow)])
def test_compiled_it_is_one_graph_with_the_same_gradients(kind):
    torch._dynamo.reset()
    loss, found = lw.objectives.SkillLatentLoss(make_actor(), kind), []
    for run in (loss, torch.compile(loss, fullgraph=True, backend="eager")):
        loss.zero_grad()
        value = run()["loss_latents"]
        value.backward()
        found.append([value.detach(), *(p.grad.clone() for p in loss.parameters() if p.grad is not None)])
    assert len(found[0]) == 5
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))


def test_its_state_goes_round():
    loss, other = lw.objectives.SkillLatentLoss(make_actor()), lw.objectives.SkillLatentLoss(make_actor(1))
    assert loss()["loss_latents"] != other()["loss_latents"]
    other.load_state_dict(loss.state_dict())
    assert torch.equal(loss()["loss_latents"], other()["loss_latents"])
    assert torch.equal(copy.deepcopy(loss)()["loss_latents"], loss()["loss_latents"])


def test_what_is_refused():
    with pytest.raises(ValueError, match=r"network is for policies with plans, .* DescriptorConditionedActor has none"):
        lw.objectives.SkillLatentLoss(lw.DescriptorConditionedActor("MT10"))
    with pytest.raises(ValueError, match=r"network is for policies with plans, .* Linear has none"):
        lw.objectives.SkillLatentLoss(torch.nn.Linear(2, 2))
    with pytest.raises(ValueError, match=r"kind must be one of .*did you mean 'contrastive'"):
        lw.objectives.SkillLatentLoss(make_actor(), "contrast")
    step = PLANS["reach"].steps[0]
    one = lw.ConditionalPlan.from_pairs("reach", [(str(step.condition), step.skill)])
    with pytest.raises(ValueError, match=f"network is for plans of at least two different skills, got {step.skill}"):
        lw.objectives.SkillLatentLoss(make_actor(plans={"reach": one}))


@pytest.mark.parametrize("kind", KINDS)
def test_reduced_otherwise_each_skill_has_a_term(kind):
    actor = make_actor()
    found = {
        r: lw.objectives.SkillLatentLoss(actor, kind, reduction=r)()["loss_latents"]
        for r in ("none", "sum", "mean", None)
    }
    assert found["none"].shape == (len(actor.encoder.skills),)
    torch.testing.assert_close(found["none"].sum(), found["sum"])
    torch.testing.assert_close(found["none"].mean(), found["mean"])
    assert torch.equal(found["mean"], found[None])
    with pytest.raises(ValueError, match="reduction must be one of 'none', 'mean', 'sum', got 'max'"):
        lw.objectives.SkillLatentLoss(actor, kind, reduction="max")
