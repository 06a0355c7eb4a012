"""Query evaluators in front of a policy: soft and hard answers, clauses, other plans, wrong logits."""

import pytest
import torch
from small_actors import assert_a_logit_for_each_step, letters, make_rows
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torch import nn
from torch.func import vmap
from torchrl.objectives import BCLoss

import lw_torchrl as lw
from lw_torchrl.language.gates import product
from lw_torchrl.modules import transform_of, with_plans

PLANS = lw.load_plans("MT10")
OTHER = lw.Plans([PLANS["push"]])
S = PLANS.num_steps


class Network(lw.QueryEvaluator):
    """An evaluator with a table for the plans, a network, and a statistic."""

    def __init__(self, plans, width=5):
        super().__init__(plans)
        self.config = {"width": width}
        self.net = nn.Sequential(nn.Linear(39, width), nn.Linear(width, 1))
        self.register_buffer("seen", torch.zeros(()))
        self.register_buffer("table", torch.ones(len(plans), plans.num_steps), persistent=False)

    def logits(self, observation, task_id):
        return self.net(observation) + self.table[0] + self.seen


class Answers(lw.QueryEvaluator):
    """An evaluator that returns the logits of a function."""

    def __init__(self, plans, make, **options):
        super().__init__(plans, **options)
        self.make = make

    def logits(self, observation, task_id):
        return self.make(*task_id.shape)


def states(rows=2, plans=PLANS):
    return make_rows(rows, plans=plans, answered=False).set("action", torch.rand(rows, 4))


def test_hard_answers_have_the_gradient_of_soft_ones():
    logits = torch.linspace(-8, 8, 2 * S).reshape(2, S).requires_grad_()
    soft = Answers(PLANS, lambda b: logits)(states())["qaf"]
    assert torch.equal(soft, logits.sigmoid())
    (slope,) = torch.autograd.grad(soft.sum(), logits)
    hard = Answers(PLANS, lambda b: logits, answers="hard")(states())["qaf"]
    assert torch.equal(hard, (logits > 0).float())
    assert torch.equal(torch.autograd.grad(hard.sum(), logits)[0], slope)


def test_hard_answers_act_as_exact_truth():
    class Truth(lw.QueryEvaluator):
        def logits(self, observation, task_id):
            rows = TensorDict(observation=observation, task_id=task_id, batch_size=task_id.shape)
            return torch.where(lw.QAFTransform(self.plans)(rows)["qaf"], 0.3, -12.0)

    actor, rows = lw.PlanConditionedActor(PLANS).eval(), states(20)
    expected = actor(lw.QAFTransform(PLANS)(rows.clone()))
    for answers in ("hard", "soft"):
        policy = TensorDictSequential(Truth(PLANS, answers=answers), actor)
        assert policy.in_keys == ["observation", "task_id"]
        output = policy(rows.clone())
        for key in ("skill_weights", "action"):
            assert torch.equal(output[key], expected[key]) is (answers == "hard"), key


def test_constructor_without_answers_is_always_soft():
    evaluator = Network(PLANS)
    assert (evaluator.answers, evaluator.config) == ("soft", {"width": 5})
    with pytest.raises(TypeError, match="answers"):
        evaluator.answers = "hard"
    evaluator = lw.modules.StateQueryEvaluator(PLANS, width=8)
    evaluator.answers = "hard"
    assert evaluator.with_plans(OTHER).answers == evaluator.config["answers"] == "hard"
    with pytest.raises(ValueError, match="answers"):
        evaluator.answers = "firm"


def test_with_plans_shares_weights_but_not_tables():
    policy = TensorDictSequential(Network(PLANS), lw.PlanConditionedActor(PLANS)).eval()
    other = with_plans(policy, OTHER)
    assert {id(one) for one in policy.parameters()} == {id(one) for one in other.parameters()}
    evaluator, own = other[0], policy[0]
    assert evaluator.seen is own.seen
    assert evaluator.table.shape == (1, OTHER.num_steps)
    assert not evaluator.training
    other(states(plans=OTHER))["action"].sum().backward()
    assert own.net[0].weight.grad is not None


def test_double_precision_and_vmap_over_rows():
    evaluator = Answers(PLANS, lambda b: torch.zeros(b, S, dtype=torch.float64))
    assert evaluator(states())["qaf"].dtype == torch.float32
    batch = torch.stack([states(), states(), states()])
    assert vmap(evaluator.logits_of)(batch).shape == (3, 2, S)


# --- evaluators of clauses -------------------------------------------------------------------------------------------


def make(plans=PLANS, seed=0, **options):
    torch.manual_seed(seed)
    return lw.modules.StateQueryEvaluator(plans, width=8, depth=1, **options)


def make_policy(**options):
    return TensorDictSequential(make(**options), lw.PlanConditionedActor(PLANS, text_encoder=letters)).eval()


def test_logits_of_each_step_for_rows_in_any_order_and_shape():
    assert_a_logit_for_each_step(make(), states(64))


def test_logits_depend_only_on_positions_that_clauses_compare():
    evaluator, output = make(), states(20)
    logits = evaluator(output.clone())["qaf_logits"]
    moved = output.clone()
    moved["observation"][:, 7:11] += 1.0  # a quaternion, which no relation compares
    assert torch.equal(evaluator(moved)["qaf_logits"], logits)


def test_or_and_else_combine_the_answers_to_clauses():
    texts = ["gripper open", "gripper near puck", "gripper open or near puck", "not (gripper open or near puck)"]
    texts += ["gripper open and (near puck or above puck)", "gripper above puck", "always", "gripper not near puck"]
    plans = lw.Plans([lw.ConditionalPlan.from_pairs("push", [(text, "grasp the puck") for text in texts])])
    evaluator = make(plans)
    logits = evaluator(states(20, plans))["qaf_logits"]
    opened, near, either, neither, nested, above, always, not_near = logits.double().sigmoid().unbind(1)
    torch.testing.assert_close(either, 1 - (1 - opened) * (1 - near), atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(neither, (1 - opened) * (1 - near), atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(nested, opened * (1 - (1 - near) * (1 - above)), atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(not_near, 1 - near, atol=1e-6, rtol=1e-5)
    assert (always > 0.999999).all()
    slopes = torch.autograd.grad(logits[:, 3].sum(), evaluator.parameters(), retain_graph=True)
    assert all(slope.isfinite().all() for slope in slopes)
    assert any(slope.any() for slope in slopes)


def test_probability_of_a_conjunction_is_the_product_with_a_finite_gradient():
    logits = torch.tensor([[0.3, -1.2, 2], [29, 30, 1e4], [4, 1e4, 1e4], [1e4, 1e4, 1e4]], requires_grad=True)
    output = product(logits)
    (slope,) = torch.autograd.grad(output.sum(), logits, retain_graph=True)
    assert slope.isfinite().all()
    assert not slope[3].any()
    p = logits.double().sigmoid().prod(-1)
    assert torch.allclose(output[:3].double(), p[:3].logit(), atol=1e-4)
    assert output[3] > 29
    assert torch.allclose(product(logits[:, :1])[:3], logits[:3, 0], atol=1e-5)


@pytest.mark.parametrize("answers", ["soft", "hard"])
@pytest.mark.filterwarnings("ignore:.*target_actor_network_params")
def test_gradient_of_imitation_reaches_the_evaluator(answers):
    policy = make_policy(answers=answers).train()
    loss = BCLoss(policy, loss_function="l2")
    loss(states(20))["loss_bc"].backward()
    output = dict(policy[0].named_parameters())
    assert len(output) >= 3
    for name, parameter in output.items():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().sum() > 0, name


def test_scripted_skills_act_on_an_evaluators_answers(tmp_path):
    evaluator = make()
    policy = TensorDictSequential(evaluator, lw.ScriptedSkillActor(PLANS))
    assert policy.in_keys == ["observation", "task_id"]
    assert transform_of(policy) is None
    rows = states(20)
    output = policy(rows.clone())
    answers = evaluator(rows.clone())["qaf_logits"] > 0
    by_truth = lw.ScriptedSkillActor(PLANS)(rows.clone().set("qaf", answers))
    for key in ("action", "skill_weights"):
        assert torch.equal(output[key], by_truth[key])
    assert output["skill_weights"][:, 1:].any()
    lw.save_actor(policy, tmp_path / "policy.safetensors")
    assert torch.equal(lw.load_actor(tmp_path / "policy.safetensors")(rows.clone())["action"], output["action"])
    other = with_plans(policy, lw.Plans([PLANS["push"]]))
    assert other[0].network.predicates.weight is evaluator.network.predicates.weight
