"""StateQueryEvaluator: what it reads, how clauses become conditions, and that it is part of a policy like any other."""

from __future__ import annotations

import pytest
import torch
from evaluator_rows import assert_a_logit_for_each_step
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.objectives import BCLoss

import lw_torchrl as lw
from lw_torchrl.language.plans import PlanStep
from lw_torchrl.language.relations import RELATIONS, Comparison
from lw_torchrl.modules import transform_of, with_plans
from lw_torchrl.modules.query_evaluator import conjunction

PLANS = lw.load_plans("MT10")


def letters(texts):
    return torch.tensor([[float(text.count(letter)) for letter in "abdefghilnoprstuw"] for text in texts])


def make(plans=PLANS, seed=0, **options):
    torch.manual_seed(seed)
    return lw.StateQueryEvaluator(plans, width=8, depth=1, **options)


def make_policy(**options):
    return TensorDictSequential(make(**options), lw.PlanConditionedActor(PLANS, text_encoder=letters)).eval()


def states(rows=20, plans=PLANS):
    generator = torch.Generator().manual_seed(0)
    ids = torch.tensor([lw.task_id(task) for task in plans]).repeat(rows)[:rows]
    return TensorDict(
        observation=torch.rand(rows, 39, generator=generator) * 0.3,
        task_id=ids,
        action=torch.rand(rows, 4, generator=generator),
        batch_size=rows,
    )


def test_a_logit_for_each_step_whatever_the_order_and_shape_of_rows():
    evaluator, found = make(), states(64)  # as many rows as evaluation's blocks have
    assert_a_logit_for_each_step(evaluator, found)


def test_structure_sees_only_the_difference_of_the_two_positions():
    evaluator, found = make(), states()
    logits = evaluator(found.clone())["qaf_logits"]
    moved = found.clone()
    moved["observation"][:, 7:11] += 1.0  # a quaternion, which no relation compares
    assert torch.equal(evaluator(moved)["qaf_logits"], logits)


def test_not_is_the_opposite_with_structure():
    texts = ["the gripper is above the puck", "the gripper is not above the puck"]
    steps = [PlanStep(lw.parse_query(text, "push"), "grasp the puck") for text in texts]
    plans = lw.Plans([lw.ConditionalPlan("push", tuple(steps))])
    logits = make(plans)(states(6, plans))["qaf_logits"]
    assert torch.allclose(logits[:, 0], -logits[:, 1], atol=1e-5)
    assert (logits[:, 0] != 0).all()


def test_a_conjunction_is_the_product_of_its_parts():
    logits = torch.tensor([[0.3, -1.2, 2.0], [29.0, 30.0, -30.0], [4.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    said = torch.tensor([[True, True, True], [True, True, False], [True, False, False], [False, False, False]])
    found = conjunction(logits, said)
    p = torch.where(said, logits.double().sigmoid(), 1.0).prod(-1)
    assert torch.allclose(found[:3].double(), p[:3].logit(), atol=1e-4)
    assert found[3] > 29
    assert torch.allclose(conjunction(logits[:, :1], said[:, :1])[:3], logits[:3, 0], atol=1e-5)


def test_a_conjunction_has_a_gradient_everywhere():
    logits = torch.tensor([[30.0, 30.0], [-30.0, -30.0], [0.0, 1.0]], requires_grad=True)
    conjunction(logits, torch.tensor([[True, True], [True, True], [False, False]])).sum().backward()
    assert logits.grad.isfinite().all()
    assert (logits.grad[2] == 0).all()


@pytest.mark.parametrize("answers", ["soft", "hard"])
@pytest.mark.filterwarnings("ignore:.*target_actor_network_params")
def test_the_loss_of_imitation_reaches_the_evaluator(answers):
    policy = make_policy(answers=answers).train()
    loss = BCLoss(policy, loss_function="l2")
    loss(states())["loss_bc"].backward()
    found = dict(policy[0].named_parameters())
    assert len(found) >= 3
    for name, parameter in found.items():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().sum() > 0, name


def test_soft_answers_are_the_papers_ten_times_the_probability_less_five():
    policy, rows = make_policy(), states()
    found = policy(rows)
    steps = [len(PLANS[lw.MT50[task]].steps) for task in rows["task_id"].tolist()]
    mask = torch.arange(PLANS.num_steps) < torch.tensor(steps)[:, None]
    logits = torch.where(mask, 10 * found["qaf_logits"].sigmoid() - 5, -torch.inf)
    assert torch.allclose(found["skill_weights"], logits.softmax(-1), atol=1e-6)


def test_saved_and_loaded_with_the_policy_to_the_bit(tmp_path):
    policy = make_policy(answers="hard")
    lw.save_actor(policy, tmp_path / "policy.safetensors")
    loaded = lw.load_actor(tmp_path / "policy.safetensors", text_encoder=letters)
    assert loaded[0].answers == "hard"
    for key in policy.out_keys:
        assert torch.equal(loaded(states())[key], policy(states())[key]), key


def test_scripted_skills_act_on_its_answers(tmp_path):
    evaluator = make()
    policy = TensorDictSequential(evaluator, lw.ScriptedSkillActor(PLANS))
    assert policy.in_keys == ["observation", "task_id"]
    assert transform_of(policy) is None
    found = policy(states())
    answers = evaluator(states())["qaf_logits"] > 0
    by_truth = lw.ScriptedSkillActor(PLANS)(states().set("qaf", answers))
    for key in ("action", "skill_weights"):
        assert torch.equal(found[key], by_truth[key])
    assert found["skill_weights"][:, 1:].any()
    lw.save_actor(policy, tmp_path / "policy.safetensors")
    assert torch.equal(lw.load_actor(tmp_path / "policy.safetensors")(states())["action"], found["action"])
    other = with_plans(policy, lw.Plans([PLANS["push"]]))
    assert other[0].network.predicates.weight is evaluator.network.predicates.weight


# ---- refusals


def test_a_relation_that_it_was_not_made_for_is_refused(monkeypatch):
    made = make()
    monkeypatch.setitem(RELATIONS, "beside", (Comparison("xyz", "<", 0.05),))
    step = PlanStep(lw.parse_query("the gripper is beside the puck", "push"), "grasp the puck")
    plans = lw.Plans([lw.ConditionalPlan("push", (step,))])
    with pytest.raises(
        ValueError,
        match=r"predicate of .*beside the puck\", in push.*make and train an evaluator",
    ):
        made.with_plans(plans)
    assert "beside" in make(plans).predicates
