"""ResidualActor of some steps of plans: where none of them is in force its base's actions, bit for bit."""

from __future__ import annotations

import json

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

import lw_torchrl as lw
from lw_torchrl.modules import make_policy
from lw_torchrl.modules.residual_actor import weight_in_force
from lw_torchrl.training.checkpoint import check_can_be_saved

PLANS = lw.load_plans("MT10")
SMALL = {"width": 16, "depth": 1}
STEPS = {"pick-place": (3, 1), "push": [0]}
TASKS = ("pick-place", "push", "reach")


class Soft(lw.QueryEvaluator):
    """Answers that are not quite sure, with a weight that could be trained."""

    def __init__(self, plans):
        super().__init__(plans)
        self.layer = torch.nn.Linear(39, self.plans.num_steps)

    def logits(self, observation, task_id):
        return 5 * self.layer(observation)


def make_actor(seed=0, steps=STEPS, scale=0.5, **options):
    torch.manual_seed(seed)
    base = lw.PlanConditionedActor(PLANS, feature_noise=0.3, **SMALL, **options)
    actor = lw.ResidualActor(base, scale=scale, steps=steps, **SMALL)
    with torch.no_grad():
        actor.network[-1].weight.normal_(std=2.0)
    return actor


def make_states(rows=64, seed=0, soft=False):
    """Rows of three tasks with any truth at all."""
    draw = torch.Generator().manual_seed(seed)
    truth = torch.rand(rows, PLANS.num_steps, generator=draw)
    ids = torch.tensor([lw.task_id(task) for task in TASKS])
    found = {
        "observation": torch.rand(rows, 39, generator=draw),
        "task_id": ids[torch.randint(3, (rows,), generator=draw)],
        "qaf": truth if soft else truth > 0.6,
    }
    return TensorDict(found, [rows])


def outside(states, weights):
    """Rows in which none of the steps has a weight of more than a hundredth, one by one."""
    found = []
    for task, row in zip(states["task_id"], weights, strict=True):
        name = next(one for one in TASKS if lw.task_id(one) == task)
        found.append(all(row[step] <= 0.01 for step in STEPS.get(name, ())))
    return torch.tensor(found)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), soft=st.booleans(), squash=st.booleans(), mode=st.booleans())
def test_outside_of_its_steps_it_does_what_its_base_does_to_the_bit(seed, soft, squash, mode):
    actor = make_actor(seed % 7, squash=squash).train(mode)
    states = make_states(seed=seed, soft=soft)
    there, base = actor(states.copy()), actor.base(states.copy())
    still = outside(states, base["skill_weights"])
    assert torch.equal(there["action"][still], base["action"][still])
    assert torch.equal(there["skill_weights"], base["skill_weights"])
    assert (there["action_corrected"].squeeze(-1) == 0).equal(still)
    assert still.any()
    assert not still.all()
    if squash:  # otherwise both may lie beyond ±1
        assert (there["action"] != base["action"])[~still].any(-1).all()


def test_in_its_steps_the_correction_has_their_weight():
    actor = make_actor()
    states = make_states()
    there, base = actor(states.copy()), actor.base(states.copy())
    encoding = actor.base.encoder.encode(*actor.base.prepare(states)).joined
    more = 0.5 * actor.network(torch.cat([encoding, base["action"]], -1)).tanh()
    expected = (base["action"] + there["action_corrected"] * more).clamp(-1, 1)
    torch.testing.assert_close(there["action"], expected)
    weights = base["skill_weights"]
    picks = states["task_id"] == lw.task_id("pick-place")
    of_both = torch.where(weights > 0.01, weights, 0)[:, [1, 3]].sum(-1)
    torch.testing.assert_close(there["action_corrected"][picks, 0], of_both[picks])


def test_at_first_it_corrects_nothing():
    torch.manual_seed(0)
    base = lw.PlanConditionedActor(PLANS, **SMALL).eval()
    states = make_states()
    actor = lw.ResidualActor(base, steps=STEPS, **SMALL)
    assert torch.equal(actor(states.copy())["action"], base(states.copy())["action"])


def test_rows_outside_of_its_steps_teach_nothing():
    actor = make_actor().train()
    states = make_states()
    still = outside(states, actor.base(states.copy())["skill_weights"])
    action = actor(states)["action"]
    parameters = list(actor.network.parameters())
    for gradient in torch.autograd.grad(action[still].sum(), parameters, retain_graph=True):
        assert not gradient.any()
    assert any(gradient.any() for gradient in torch.autograd.grad(action[~still].sum(), parameters))
    assert {name for name, p in actor.named_parameters() if p.requires_grad} == {
        name for name, _ in actor.named_parameters() if name.startswith("network.")
    }


@given(st.lists(st.floats(0, 1, width=32), min_size=4, max_size=4), st.lists(st.booleans(), min_size=4, max_size=4))
def test_a_weight_of_a_hundredth_is_not_in_force(weights, chosen):
    found = weight_in_force(torch.tensor([weights]), torch.tensor([chosen]))
    bounds = torch.tensor(weights)
    expected = bounds[torch.tensor(chosen) & (bounds > 0.01)].sum()
    torch.testing.assert_close(found[0, 0], expected)
    assert (found[0, 0] == 0) == (not any(c and w > 0.01 for c, w in zip(chosen, bounds, strict=True)))


def test_an_evaluators_weights_count():
    actor = make_actor(evaluator=Soft(PLANS))
    states = make_states().exclude("qaf")
    there, base = actor(states.copy()), actor.base(states.copy())
    still = outside(states, base["skill_weights"])
    assert torch.equal(there["action"][still], base["action"][still])
    assert not torch.equal(there["action"], base["action"])


def test_it_is_saved_and_loaded(tmp_path):
    actor = make_actor().eval()
    check_can_be_saved(actor)
    lw.save_actor(actor, tmp_path / "policy.safetensors")
    again = lw.load_actor(tmp_path / "policy.safetensors").eval()
    assert again.steps == {"pick-place": [1, 3], "push": [0]}
    assert json.dumps(again.describe()) == json.dumps(actor.describe())
    assert again.out_keys == ["action", "skill_weights", "action_corrected"]
    states = make_states()
    assert torch.equal(again(states.copy())["action"], actor(states.copy())["action"])


def test_keys_of_ones_own_keep_their_nest():
    torch.manual_seed(0)
    base = lw.PlanConditionedActor(PLANS, out_keys=[("agent", "move"), ("agent", "weights"), "latent"], **SMALL)
    actor = lw.ResidualActor(base, steps=STEPS, **SMALL)
    assert actor.out_keys == [("agent", "move"), ("agent", "weights"), ("agent", "move_corrected")]
    assert actor(make_states())["agent", "move_corrected"].shape == (64, 1)


WRONG = [
    ({"pick-plaec": [1]}, ValueError, r"steps: task must be one of .* got 'pick-plaec'; did you mean 'pick-place'"),
    ({"soccer": [0]}, ValueError, "steps: task must be one of "),
    ({3: [0]}, ValueError, "steps: task must be one of .* got 3"),
    ({"pick-place": [4]}, ValueError, r"steps of 'pick-place' must be from 0 to 3, got 4"),
    ({"pick-place": [10**30]}, ValueError, "steps of 'pick-place' must be from 0 to 3"),
    ({"pick-place": [-1]}, ValueError, "steps of 'pick-place' must be at least 0, got -1"),
    ({"pick-place": ["1"]}, TypeError, "steps of 'pick-place' must be an integer, got '1'"),
    ({"pick-place": "1"}, TypeError, "steps of 'pick-place' must be a list of numbers, got '1'"),
    ({"pick-place": [True]}, TypeError, r"steps of 'pick-place' must be an integer, got True \(bool\)"),
    ({"pick-place": [1.0]}, TypeError, "steps of 'pick-place' must be an integer, got 1.0"),
    ({"pick-place": 1}, TypeError, "steps of 'pick-place' must be a list of numbers, got 1"),
    ({"pick-place": [1, 1]}, ValueError, r"steps of 'pick-place' must be different ones of its plan's 4, got \[1, 1\]"),
    ({"pick-place": []}, ValueError, "steps of 'pick-place' must be different ones"),
    ({"pick-place": [0] * 100_000}, ValueError, "steps of 'pick-place' must be different .* got 100000"),
    ({}, ValueError, "steps must name a step of a plan at least, got none"),
    ([1], TypeError, r"steps must map names of tasks to steps of their plans, got \[1\]"),
]


@pytest.mark.parametrize(("steps", "kind", "message"), WRONG, ids=[str(steps)[:30] for steps, _, _ in WRONG])
def test_steps_that_are_not_there_are_refused_by_name(steps, kind, message, tmp_path):
    with pytest.raises(kind, match=message):
        make_actor(steps=steps)


def test_a_base_without_plans_is_refused():
    with pytest.raises(TypeError, match="steps are of plans, which the base, a DescriptorConditionedActor, does not"):
        lw.ResidualActor(make_policy("dc", PLANS, **SMALL), steps=STEPS)


def test_other_plans_must_have_the_steps():
    actor = make_actor().eval()
    other = actor.with_plans(lw.load_plans("MT50"))
    assert other.steps == actor.steps
    assert other.network is actor.network
    states = make_states(rows=1)
    qaf = torch.zeros(1, other.plans.num_steps, dtype=torch.bool)
    qaf[:, :4] = states["qaf"][:, :4]
    torch.testing.assert_close(other(states.copy().set("qaf", qaf))["action"], actor(states.copy())["action"])
    with pytest.raises(ValueError, match="steps: task must be one of 'reach', got 'pick-place'"):
        actor.with_plans({"reach": PLANS["reach"]})
    pairs = [(step.condition, step.skill) for step in PLANS["pick-place"].steps]
    short = lw.Plans([lw.ConditionalPlan.from_pairs("pick-place", pairs[:3]), PLANS["push"]])
    with pytest.raises(ValueError, match="steps of 'pick-place' must be from 0 to 2, got 3"):
        actor.with_plans(short)
    turned = lw.Plans([lw.ConditionalPlan.from_pairs("pick-place", pairs[::-1]), PLANS["push"]])
    with pytest.raises(ValueError, match="step 1 must have the skill 'lower the gripper around the puck', got 'close"):
        actor.with_plans(turned)


def test_many_are_run_as_one():
    actors = [make_actor(seed).eval() for seed in range(2)]
    parameters, buffers = torch.func.stack_module_state(actors)
    states = make_states(rows=8)
    prepared = actors[0].prepare(states)

    def act(weights, tables):
        class Bare(torch.nn.Module):
            def __init__(self):
                super().__init__()
                self.actor = actors[0]

            def forward(self, *given):
                return self.actor.act(*given)

        given = {f"actor.{name}": value for name, value in {**weights, **tables}.items()}
        return torch.func.functional_call(Bare(), given, prepared)

    found = torch.func.vmap(act)(parameters, buffers)
    for number, actor in enumerate(actors):
        torch.testing.assert_close(found[0][number], actor.act(*prepared)[0])
