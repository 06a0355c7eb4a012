"""ImageQueryEvaluator: what its network sees, and its place in a policy."""

import pytest
import torch
from pictures import why_no_pictures
from small_actors import assert_a_logit_for_each_step, letters
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torch import nn

import lw_torchrl as lw
from lw_torchrl.modules import IMAGE_ENCODERS

TASKS = ("drawer-open", "reach")
PLANS = lw.Plans({task: lw.load_plans("MT10")[task] for task in TASKS})
SMALL = {"height": 16, "width": 24, "hidden": 8, "depth": 1}


def make(plans=PLANS, seed=0, **options):
    torch.manual_seed(seed)
    return lw.modules.ImageQueryEvaluator(plans, **SMALL, **options)


def make_policy(**options):
    return TensorDictSequential(make(**options), lw.PlanConditionedActor(PLANS, text_encoder=letters))


def states(rows=10, shape=(16, 48)):
    generator = torch.Generator().manual_seed(0)
    return TensorDict(
        observation=torch.rand(rows, 39, generator=generator) * 0.3,
        pixels=torch.randint(256, (rows, *shape, 3), generator=generator, dtype=torch.uint8),
        task_id=torch.tensor([lw.task_id(task) for task in TASKS]).repeat(rows)[:rows],
        action=torch.rand(rows, 4, generator=generator),
        batch_size=rows,
    )


def test_logits_of_each_step_for_rows_in_any_order_and_shape():
    assert_a_logit_for_each_step(make(), states(64))


def test_logits_depend_on_every_picture_and_not_on_the_observation():
    evaluator, output = make(), states()
    logits = evaluator(output.clone())["qaf_logits"]
    other = output.clone().set("observation", torch.zeros(10, 39))
    assert torch.equal(evaluator(other)["qaf_logits"], logits)
    for part in (slice(0, 24), slice(24, 48)):
        other = output.clone()
        other["pixels"][:, :, part] = 0
        assert not torch.equal(evaluator(other)["qaf_logits"], logits)


def test_attention_is_a_distribution_over_each_picture():
    evaluator, output = make(), states()
    with torch.no_grad():
        places, seen = evaluator.network.places(output["pixels"], evaluator.network.names.weight)
    assert places.shape == (10, len(evaluator.names), 4)
    assert seen.shape == (10, 2, len(evaluator.names), 8, 12)
    assert torch.allclose(seen.sum((-1, -2)), torch.ones(()))
    swapped = output["pixels"].unflatten(-2, (2, 24)).flip(-3).flatten(-3, -2)
    with torch.no_grad():
        _, other = evaluator.network.places(swapped, evaluator.network.names.weight)
    assert torch.allclose(other, seen.flip(1), atol=1e-6)


def test_attention_follows_an_object_in_the_picture():
    """A key that matches only red: its attention is where the red square is."""
    IMAGE_ENCODERS["red"] = lambda: nn.AvgPool2d(2)
    try:
        network = make(cameras="corner", encoder="red").network
    finally:
        del IMAGE_ENCODERS["red"]
    with torch.no_grad():
        network.key.weight.zero_()
        network.key.weight[0, 0] = 50.0
        objects = torch.zeros(1, 32)
        objects[0, 0] = 10.0
        pixels = torch.zeros(2, 16, 24, 3, dtype=torch.uint8)
        pixels[0, 2:4, 4:6, 0] = 255
        pixels[1, 12:14, 20:22, 0] = 255
        _, seen = network.places(pixels, objects)
    assert seen[0, 0, 0].argmax() == 1 * 12 + 2
    assert seen[1, 0, 0].argmax() == 6 * 12 + 10
    assert (seen.amax((-1, -2)) > 0.99).all()


def test_saved_and_loaded_policy_with_evaluator_gives_the_same_bits(tmp_path):
    policy = make_policy().eval()
    lw.save_actor(policy, tmp_path / "policy.safetensors")
    again = lw.load_actor(tmp_path / "policy.safetensors", text_encoder=letters)
    assert torch.equal(again(states())["action"], policy(states())["action"])
    lw.training.save_evaluator(policy[0], tmp_path / "evaluator.safetensors")
    other = lw.training.load_evaluator(tmp_path / "evaluator.safetensors", PLANS, text_encoder=letters)
    assert torch.equal(other(states())["qaf_logits"], policy[0](states())["qaf_logits"])


class TestActing:
    @pytest.fixture(autouse=True)
    def _needs_open_gl(self):
        if missing := why_no_pictures():
            pytest.skip(missing)

    def evaluated(self, actor, **options):
        settings = {"tasks": TASKS, "episodes_per_task": 2, "seed": 1000, "max_steps": 12, "progress": False}
        result = lw.evaluate(actor, record_actions=True, **settings | options)
        return [one.actions for one in result.episodes]

    @pytest.mark.slow
    def test_results_do_not_depend_on_num_envs(self):
        actor = TensorDictSequential(make(), lw.PlanConditionedActor(PLANS))
        output = [self.evaluated(actor, num_envs=n, num_threads=t) for n, t in ((2, 1), (4, 2))]
        for one, other in zip(*output, strict=True):
            assert torch.equal(one, other)

    def test_evaluator_in_a_sequence_equals_evaluator_as_an_argument(self):
        evaluator = make(every=4)
        own = self.evaluated(TensorDictSequential(evaluator, lw.ScriptedSkillActor(PLANS)))
        behind = self.evaluated(lw.ScriptedSkillActor(PLANS), evaluator=evaluator)
        for one, other in zip(own, behind, strict=True):
            assert torch.equal(one, other)
