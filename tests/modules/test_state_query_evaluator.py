"""StateQueryEvaluator: what it reads, how clauses become conditions, and its use in front of a policy."""

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
from lw_torchrl.modules.clause_evaluator import conjunction

PLANS = lw.load_plans("MT10")


def letters(texts):
    return torch.tensor([[float(text.count(letter)) for letter in "abdefghilnoprstuw"] for text in texts])


def make(plans=PLANS, seed=0, **options):
    torch.manual_seed(seed)
    return lw.StateQueryEvaluator(plans, width=8, depth=1, **options)


def make_actor(answers="soft"):
    evaluator = make(answers=answers)
    return TensorDictSequential(evaluator, lw.PlanConditionedActor(PLANS, text_encoder=letters)).eval()


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
    actor = make_actor(answers).train()
    BCLoss(actor, loss_function="l2")(states())["loss_bc"].backward()
    weights = dict(actor[0].named_parameters())
    assert len(weights) >= 3
    assert all(weight.grad.abs().sum() > 0 for weight in weights.values())


class Truth(lw.QueryEvaluator):
    def __init__(self, plans, **options):
        super().__init__(plans, **options)
        self.exact = lw.QAFTransform(plans)

    def logits(self, observation, task_id):
        rows = TensorDict(observation=observation, task_id=task_id, batch_size=task_id.shape)
        return torch.where(self.exact(rows)["qaf"], 0.3, -12.0)


def test_hard_answers_act_as_exact_truth_does():
    actor, rows = lw.PlanConditionedActor(PLANS, text_encoder=letters).eval(), states()
    expected = actor(lw.QAFTransform(PLANS)(rows.clone()))
    hard = TensorDictSequential(Truth(PLANS, answers="hard"), actor)(rows.clone())
    assert torch.equal(hard["skill_weights"], expected["skill_weights"])
    assert torch.equal(hard["action"], expected["action"])
    soft = TensorDictSequential(Truth(PLANS), actor)(rows.clone())
    assert not torch.equal(soft["skill_weights"], expected["skill_weights"])


def test_soft_answers_are_probabilities():
    evaluator, rows = make(), states()
    found = evaluator(rows.clone())
    assert torch.equal(found["qaf"], found["qaf_logits"].sigmoid())
    evaluator.answers = "hard"
    found = evaluator(rows.clone())
    assert torch.equal(found["qaf"], (found["qaf_logits"] > 0).float())
    with pytest.raises(ValueError, match="answers must be one of 'soft', 'hard', got 'tanh'"):
        evaluator.answers = "tanh"


def test_with_plans_shares_the_network():
    actor, other = make_actor(), lw.Plans([PLANS["push"]])
    found = lw.modules.with_plans(actor, other)
    assert {id(one) for one in actor.parameters()} == {id(one) for one in found.parameters()}
    rows = states(4, other)
    torch.testing.assert_close(found(rows.clone())["action"], actor(rows.clone())["action"])


@pytest.mark.parametrize("answers", ["soft", "hard"])
def test_saved_and_loaded_with_the_policy_to_the_bit(answers, tmp_path):
    actor = make_actor(answers)
    lw.save_actor(actor, tmp_path / "policy.safetensors")
    loaded = lw.load_actor(tmp_path / "policy.safetensors", text_encoder=letters)
    assert loaded[0].answers == answers
    for key in actor.out_keys:
        assert torch.equal(loaded(states())[key], actor(states())[key]), key


def test_scripted_skills_act_on_its_answers(tmp_path):
    evaluator, scripted = make(), lw.ScriptedSkillActor(PLANS)
    actor = TensorDictSequential(evaluator, scripted)
    assert actor.in_keys == ["observation", "task_id"]
    assert lw.modules.transform_of(actor) is None
    found = actor(states())
    expected = scripted(states().set("qaf", evaluator(states())["qaf_logits"] > 0))
    for key in ("action", "skill_weights"):
        assert torch.equal(found[key], expected[key])
    assert found["skill_weights"][:, 1:].any()
    lw.save_actor(actor, tmp_path / "policy.safetensors")
    assert torch.equal(lw.load_actor(tmp_path / "policy.safetensors")(states())["action"], found["action"])


def test_an_evaluation_uses_the_sign_of_its_answers():
    class Never(lw.QueryEvaluator):
        def logits(self, observation, task_id):
            return torch.full((*task_id.shape, self.plans.num_steps), -1.0)

    episodes, plans = [], lw.Plans([PLANS["reach"]])
    run = dict(tasks="reach", episodes_per_task=1, seed=1_000, max_steps=5, progress=False, also_record=["qaf"])
    lw.evaluate(lw.ScriptedSkillActor(plans), **run, evaluator=Never(plans), on_episode=episodes.append)
    assert not episodes[0].steps["qaf"].any()


# ---- refusals


def test_a_relation_that_it_was_not_made_for_is_refused(monkeypatch):
    made = make()
    monkeypatch.setitem(RELATIONS, "beside", (Comparison("xyz", "<", 0.05),))
    step = PlanStep(lw.parse_query("the gripper is beside the puck", "push"), "grasp the puck")
    plans = lw.Plans([lw.ConditionalPlan("push", (step,))])
    with pytest.raises(ValueError, match=r"predicate of .*beside the puck\", in push must be one of"):
        made.with_plans(plans)
    assert "beside" in make(plans).predicates
