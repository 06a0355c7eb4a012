"""Query evaluators in front of a policy: soft and hard answers, clauses, other plans, wrong logits, pictures."""

import pytest
import torch
from pictures import why_no_pictures
from small_actors import assert_a_logit_for_each_step, letters, make_rows
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torch import nn
from torch.func import vmap
from torchrl.objectives import BCLoss

import lw_torchrl as lw
from lw_torchrl.language.gates import product
from lw_torchrl.modules import IMAGE_ENCODERS, transform_of, with_plans

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
    return make_rows(rows, plans=plans, answered=False)


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
    assert other[0].seen is policy[0].seen
    assert (other[0].table.shape, other[0].training) == ((1, OTHER.num_steps), False)
    other(states(plans=OTHER))["action"].sum().backward()
    assert policy[0].net[0].weight.grad is not None


def test_double_precision_and_vmap_over_rows():
    evaluator = Answers(PLANS, lambda b: torch.zeros(b, S, dtype=torch.float64))
    assert evaluator(states())["qaf"].dtype == torch.float32
    batch = torch.stack([states(), states(), states()])
    assert vmap(evaluator.logits_of)(batch).shape == (3, 2, S)


# --- evaluators of clauses -------------------------------------------------------------------------------------------


def make(plans=PLANS, seed=0, **options):
    torch.manual_seed(seed)
    return lw.modules.StateQueryEvaluator(plans, width=8, depth=1, **options)


def test_logits_of_each_step_for_rows_in_any_order_and_shape():
    assert_a_logit_for_each_step(make_seeing(), pictures(64))
    evaluator, moved = make(), states(64)
    logits = assert_a_logit_for_each_step(evaluator, moved)
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
    policy = TensorDictSequential(make(answers=answers), lw.PlanConditionedActor(PLANS, text_encoder=letters))
    loss = BCLoss(policy, loss_function="l2")
    loss(states(20).set("action", torch.rand(20, 4)))["loss_bc"].backward()
    output = dict(policy[0].named_parameters())
    assert len(output) >= 3
    assert [name for name, each in output.items() if each.grad is None or not each.grad.any()] == []


def test_scripted_skills_act_on_an_evaluators_answers(tmp_path):
    evaluator = make()
    policy = TensorDictSequential(evaluator, lw.ScriptedSkillActor(PLANS))
    assert policy.in_keys == ["observation", "task_id"]
    assert transform_of(policy) is None
    rows = states(20)
    output = policy(rows.clone())
    answers = evaluator(rows.clone())["qaf_logits"] > 0
    by_truth = lw.ScriptedSkillActor(PLANS)(rows.clone().set("qaf", answers))
    assert all(torch.equal(output[key], by_truth[key]) for key in ("action", "skill_weights"))
    assert output["skill_weights"][:, 1:].any()
    lw.save_actor(policy, tmp_path / "policy.safetensors")
    assert torch.equal(lw.load_actor(tmp_path / "policy.safetensors")(rows.clone())["action"], output["action"])
    other = with_plans(policy, OTHER)
    assert other[0].network.predicates.weight is evaluator.network.predicates.weight


TASKS = ("drawer-open", "reach")
TWO = lw.Plans({task: PLANS[task] for task in TASKS})
SIZE = {"height": 16, "width": 24, "hidden": 8, "depth": 1}


def make_seeing(**options):
    torch.manual_seed(0)
    return lw.modules.ImageQueryEvaluator(TWO, **SIZE, **options)


def pictures(rows=10, shape=(16, 48)):
    generator = torch.Generator().manual_seed(0)
    return TensorDict(
        observation=torch.rand(rows, 39, generator=generator) * 0.3,
        pixels=torch.randint(256, (rows, *shape, 3), generator=generator, dtype=torch.uint8),
        task_id=torch.tensor([lw.task_id(task) for task in TASKS]).repeat(rows)[:rows],
        action=torch.rand(rows, 4, generator=generator),
        batch_size=rows,
    )


def test_logits_depend_on_every_picture_and_not_on_the_observation():
    evaluator, output = make_seeing(), pictures()
    logits = evaluator(output.clone())["qaf_logits"]
    other = output.clone().set("observation", torch.zeros(10, 39))
    assert torch.equal(evaluator(other)["qaf_logits"], logits)
    for part in (slice(0, 24), slice(24, 48)):
        other = output.clone()
        other["pixels"][:, :, part] = 0
        assert not torch.equal(evaluator(other)["qaf_logits"], logits)


def test_attention_is_a_distribution_over_each_picture():
    evaluator, output = make_seeing(), pictures()
    swapped = output["pixels"].unflatten(-2, (2, 24)).flip(-3).flatten(-3, -2)
    with torch.no_grad():
        places, seen = evaluator.network.places(output["pixels"], evaluator.network.names.weight)
        _, other = evaluator.network.places(swapped, evaluator.network.names.weight)
    assert places.shape == (10, len(evaluator.names), 4)
    assert seen.shape == (10, 2, len(evaluator.names), 8, 12)
    assert torch.allclose(seen.sum((-1, -2)), torch.ones(()))
    assert torch.allclose(other, seen.flip(1), atol=1e-6)


def test_attention_follows_an_object_in_the_picture():
    """A key that matches only red: its attention is where the red square is."""
    IMAGE_ENCODERS["red"] = lambda: nn.AvgPool2d(2)
    try:
        network = make_seeing(cameras="corner", encoder="red").network
    finally:
        del IMAGE_ENCODERS["red"]
    with torch.no_grad():
        network.key.weight.zero_()
        network.key.weight[0, 0] = 50.0
        objects = torch.tensor([[10.0] + [0.0] * 31])
        pixels = torch.zeros(2, 16, 24, 3, dtype=torch.uint8)
        pixels[0, 2:4, 4:6, 0] = 255
        pixels[1, 12:14, 20:22, 0] = 255
        _, seen = network.places(pixels, objects)
    assert [each.argmax() for each in seen[:, 0, 0]] == [1 * 12 + 2, 6 * 12 + 10]
    assert (seen.amax((-1, -2)) > 0.99).all()


def test_saved_and_loaded_policy_with_evaluator_gives_the_same_bits(tmp_path):
    policy = TensorDictSequential(make_seeing(), lw.PlanConditionedActor(TWO, text_encoder=letters)).eval()
    lw.save_actor(policy, tmp_path / "policy.safetensors")
    again = lw.load_actor(tmp_path / "policy.safetensors", text_encoder=letters)
    assert torch.equal(again(pictures())["action"], policy(pictures())["action"])
    lw.training.save_evaluator(policy[0], tmp_path / "evaluator.safetensors")
    other = lw.training.load_evaluator(tmp_path / "evaluator.safetensors", TWO, text_encoder=letters)
    assert torch.equal(other(pictures())["qaf_logits"], policy[0](pictures())["qaf_logits"])


def assert_the_same_actions(first, second):
    """Evaluate two pairs (actor, options), and compare their episodes."""
    if missing := why_no_pictures():
        pytest.skip(missing)
    settings = {"tasks": TASKS, "episodes_per_task": 2, "seed": 1000, "max_steps": 12, "progress": False}
    results = [lw.evaluate(actor, record_actions=True, **settings, **more) for actor, more in (first, second)]
    for one, other in zip(*(result.episodes for result in results), strict=True):
        assert torch.equal(one.actions, other.actions)


@pytest.mark.slow
def test_results_do_not_depend_on_num_envs():
    actor = TensorDictSequential(make_seeing(), lw.PlanConditionedActor(TWO))
    assert_the_same_actions((actor, {"num_envs": 2, "num_threads": 1}), (actor, {"num_envs": 4, "num_threads": 2}))


def test_evaluator_in_a_sequence_equals_evaluator_as_an_argument():
    evaluator, actor = make_seeing(every=4), lw.ScriptedSkillActor(TWO)
    assert_the_same_actions((TensorDictSequential(evaluator, actor), {}), (actor, {"evaluator": evaluator}))
