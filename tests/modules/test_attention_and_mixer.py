"""PlanAttention, the softmax of 10·truth - 5 over the steps that exist, and SkillMixer, one latent for each skill."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from small_actors import FALLBACK, PLANS, letters, make_rows
from tensordict import TensorDict
from torch import nn

import lw_torchrl as lw
from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.language.roles import role_vectors
from lw_torchrl.language.tasks import task_id
from lw_torchrl.modules import PlanAttention, SkillMixer, attend


def make_plan(task, steps):
    return ConditionalPlan.from_pairs(task, [("the gripper is open", f"move {i} times") for i in range(steps)])


THREE = Plans([make_plan("push", 4), make_plan("reach", 2), make_plan("sweep", 1)])
PUSH, REACH, SWEEP = (task_id(task) for task in THREE)
LENGTH = {PUSH: 4, REACH: 2, SWEEP: 1}


def weights(qaf, task_ids):
    qaf, task_ids = torch.as_tensor(qaf), torch.as_tensor(task_ids)
    return PlanAttention(THREE)(TensorDict({"qaf": qaf, "task_id": task_ids}, task_ids.shape))["skill_weights"]


def test_weights_are_the_softmax_by_hand():
    output = weights([[True, False, True, False], [False, True, False, False]], [PUSH, REACH])
    high, low = math.exp(5), math.exp(-5)
    push = [high, low, high, low]
    expected = [[x / sum(push) for x in push], [low / (high + low), high / (high + low), 0, 0]]
    torch.testing.assert_close(output, torch.tensor(expected))
    assert output.dtype == torch.float32


def test_gradient_reaches_soft_truth_but_not_padding():
    qaf = torch.full((1, 4), 0.5, requires_grad=True)
    weights(qaf, [REACH])[0, 0].backward()
    assert qaf.grad.sign().tolist() == [[1, -1, 0, 0]]


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(1, 3), max_size=3), st.integers(0, 2**31), st.booleans())
def test_weights_sum_to_one_over_the_real_steps_for_any_leading_shape(shape, seed, soft):
    generator = torch.Generator().manual_seed(seed)
    task_ids = torch.tensor(list(LENGTH))[torch.randint(3, tuple(shape), generator=generator)]
    qaf = torch.rand(*shape, 4, generator=generator)
    output = weights(qaf if soft else qaf > 0.5, task_ids)
    assert output.shape == (*shape, 4)
    torch.testing.assert_close(output.sum(-1), torch.ones(tuple(shape)))
    lengths = task_ids.clone().apply_(LENGTH.get)
    padding = torch.arange(4) >= lengths.unsqueeze(-1)
    assert (output[padding] == 0).all()
    assert (output[~padding] > 0).all()


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-20, 20, width=32), min_size=5, max_size=5), st.lists(st.booleans(), min_size=4, max_size=4))
def test_attend_is_a_softmax_over_the_mask(logits, mask):
    logits, mask = torch.tensor(logits), torch.tensor([*mask, True])
    output = attend(logits, mask)
    torch.testing.assert_close(output[mask], logits[mask].softmax(-1))
    assert not output[~mask].any()
    torch.testing.assert_close(attend(logits + 3.0, mask), output)


def test_a_wider_qaf_is_read_if_qaf_plan_shows_the_same_plan():
    """A policy of two plans reads rows that were answered for ten, of which some are longer."""
    two = lw.Plans([PLANS["reach"], PLANS["drawer-open"]])
    rows = make_rows(5, plans=two, answered=False)
    wide, narrow = lw.QAFTransform(PLANS)(rows.clone()), lw.QAFTransform(two)(rows.clone())
    assert wide["qaf"].shape[-1] > narrow["qaf"].shape[-1]
    for module in (PlanAttention(two), lw.ScriptedSkillActor(two)):
        assert torch.equal(module(wide.clone())[module.out_keys[-1]], module(narrow.clone())[module.out_keys[-1]])
        with pytest.raises(ValueError, match="qaf"):
            module(wide.exclude("qaf_plan"))
    assert lw.PlanConditionedQValue(two)(wide.set("action", torch.zeros(5, 4)))["state_action_value"].shape == (5, 1)


APPROACH, HELD = {"approach"}, {"approach", "descend", "close"}


TURNS = [(None, ()), (0, ()), (1, APPROACH), (2, {*HELD, "move"}), (3, ()), (4, APPROACH), (11, {*HELD, "carry"})]


@pytest.mark.parametrize(("turn", "verbs"), TURNS)
def test_fallback_steps_have_their_own_turns(turn, verbs):
    """The plan, which carries; letting go, sliding; the plan, letting go, carrying; and so on."""
    attention = PlanAttention(FALLBACK)
    assert attention.in_keys == ["qaf", "task_id", "turn"]
    rows = TensorDict(qaf=torch.rand(8, FALLBACK.num_steps), task_id=torch.full((8,), PUSH), batch_size=[8])
    if turn is not None:
        rows["turn"] = torch.full((8,), turn)
    roles = [step.role for step in FALLBACK["push"].steps]
    output = attention(rows)["skill_weights"][:, : len(roles)]
    active = torch.tensor([role.verb in verbs if role.fallback else not verbs for role in roles])
    torch.testing.assert_close(output[:, active].sum(-1), torch.ones(8))
    assert not output[:, ~active].any()


def test_with_plans_keeps_the_keys():
    attention = PlanAttention(THREE, in_keys=["truth", ("words", "task")], out_keys=["weights"])
    other = attention.with_plans(Plans([make_plan("reach", 3)]))
    assert (other.in_keys, other.out_keys) == (attention.in_keys, ["weights"])
    rows = TensorDict({"truth": torch.zeros(2, 3), ("words", "task"): torch.full((2,), REACH)}, [2])
    torch.testing.assert_close(other(rows)["weights"], torch.full((2, 3), 1 / 3))


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
