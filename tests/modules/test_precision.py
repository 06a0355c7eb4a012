"""Half and double precision, gradients of single rows, and float32 whatever torch.set_default_dtype says."""

import pytest
import torch
from small_actors import ACTORS, PLANS, make_actor, make_descriptor, make_rows, rows_for, small_decoder
from torch.func import functional_call, grad, vmap
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

import lw_torchrl as lw

MODULES = ACTORS | {
    "value": lambda: lw.PlanConditionedValue(PLANS, ensemble=2, width=8, depth=1),
    "value of actions": lambda: lw.PlanConditionedQValue(PLANS, width=8, depth=1),
}


@pytest.mark.parametrize("rows_too", [True, False], ids=["rows too", "float32 rows"])
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float64])
@pytest.mark.parametrize("name", [name for name in MODULES if name != "scripted"])
def test_other_precisions_give_nearly_the_same_output(name, dtype, rows_too):
    module = MODULES[name]().eval()
    rows = rows_for(module, 6).set("action", torch.rand(6, 4))
    key = "action" if "action" in module.out_keys else module.out_keys[-1]
    expected = module(rows.copy())[key]
    cast = rows.copy().set("observation", rows["observation"].to(dtype)) if rows_too else rows.copy()
    output = module.to(dtype)(cast)[key]
    assert output.dtype == dtype
    if name == "decided":
        output, expected = output[:, :3], expected[:, :3]
    limit = 0.1 if dtype == torch.bfloat16 else 1e-4
    torch.testing.assert_close(output.float(), expected, atol=limit, rtol=limit)


@pytest.mark.parametrize("make", [make_actor, make_descriptor])
def test_gradients_of_single_rows_sum_to_the_batch_gradient(make):
    actor = make(decoder=small_decoder(), **{"plans" if make is make_actor else "tasks": PLANS})
    rows = make_rows(5)
    params = {name: weight.detach() for name, weight in actor.named_parameters()}
    tensors = {key: rows[key] for key in actor.in_keys}

    def loss(params, tensors):
        return functional_call(actor, params, (), tensors)[-1].square().sum()

    each = vmap(grad(loss), (None, 0))(params, tensors)
    actor(rows.copy())["action"].square().sum().backward()
    for name, weight in actor.named_parameters():
        assert each[name].shape == (5, *weight.shape)
        torch.testing.assert_close(each[name].sum(0), weight.grad, atol=1e-5, rtol=1e-4)


@pytest.fixture
def default_is_float64():
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def floats(tensordict):
    return {value.dtype for value in tensordict.values(True, True) if value.is_floating_point()}


def test_environments_and_policies_are_float32(default_is_float64):
    env = TransformedEnv(lw.LanguageWorldEnv(["reach", "push"], num_envs=2, max_steps=5), lw.QAFTransform(PLANS))
    check_env_specs(env)
    for actor in (None, lw.load_actor("few-shot-mt50"), lw.PlanConditionedActor(PLANS), lw.ScriptedSkillActor(PLANS)):
        transform = None if actor is None else lw.modules.transform_of(actor)
        own = env if transform is None else TransformedEnv(lw.LanguageWorldEnv("reach", max_steps=5), transform)
        for mode in (torch.no_grad(), torch.inference_mode()):
            with mode:
                assert floats(own.rollout(3, actor).exclude("next")) == {torch.float32}


def test_training_and_losses_are_float32(default_is_float64, tmp_path):
    lw.collect_demonstrations("reach", episodes_per_task=1, root=tmp_path / "demos", max_steps=20, progress=False)
    transform = lw.QAFTransform(PLANS)
    replay = lw.LanguageWorldExperienceReplay(tmp_path / "demos", batch_size=4, transform=transform)
    assert floats(replay.sample()) == {torch.float32}
    actor = lw.PlanConditionedActor(PLANS)
    config = lw.BehavioralCloningConfig(steps=2, batch_size=4)
    lw.BehavioralCloningTrainer(actor, replay, config, progress=False).train()
    assert {parameter.dtype for parameter in actor.parameters()} == {torch.float32}
    value = lw.modules.Value(lw.modules.descriptor_trunk(PLANS))
    assert value(replay.sample())["state_value"].dtype == torch.float32
