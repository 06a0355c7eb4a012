"""Everything is float32, whatever torch.set_default_dtype and inference mode say."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

import lw_torchrl as lw

PLANS = lw.load_plans("MT10")


@pytest.fixture(autouse=True)
def _float64():
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def floats(tensordict):
    return {value.dtype for value in tensordict.values(True, True) if value.is_floating_point()}


def test_environments_and_policies_are_float32():
    env = TransformedEnv(lw.LanguageWorldEnv(["reach", "push"], num_envs=2, max_steps=5), lw.QAFTransform(PLANS))
    check_env_specs(env)
    for actor in (None, lw.load_actor("few-shot-mt50"), lw.PlanConditionedActor(PLANS), lw.ScriptedSkillActor(PLANS)):
        transform = None if actor is None else lw.modules.transform_of(actor)
        own = env if transform is None else TransformedEnv(lw.LanguageWorldEnv("reach", max_steps=5), transform)
        for mode in (torch.no_grad(), torch.inference_mode()):
            with mode:
                assert floats(own.rollout(3, actor).exclude("next")) == {torch.float32}


def test_a_policy_gives_the_same_actions_as_with_float32():
    env = TransformedEnv(lw.LanguageWorldEnv("reach", max_steps=5), lw.QAFTransform(lw.load_plans("MT50")))
    state = env.reset()
    actions = []
    for dtype in (torch.float64, torch.float32):
        torch.set_default_dtype(dtype)
        actions.append(lw.load_actor("few-shot-mt50")(state.clone())["action"])
    torch.testing.assert_close(*actions, rtol=0, atol=0)


def test_training_and_losses_are_float32(tmp_path):
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


@pytest.mark.parametrize(
    "make",
    [
        lambda: lw.transforms.RandomYaw(0.1),
        lambda: lw.transforms.RandomYaw(0.1, plans=lw.canonical_plans(PLANS), tilt=0.5),
        lambda: lw.transforms.HideOpening(0.5),
        lambda: lw.transforms.SwapUnmentioned(PLANS, 0.5),
        lambda: lw.transforms.JitterTarget(lw.canonical_plans(PLANS), 0.1),
    ],
    ids=range(5),
)
def test_augmentations_are_float32(make):
    rows = TensorDict(observation=torch.rand(4, 39, dtype=torch.float32), batch_size=[4])
    rows["task_id"] = torch.full((4,), lw.task_id("reach"))
    rows["action"] = torch.zeros(4, 4, dtype=torch.float32)
    transform = make()
    plans = PLANS if isinstance(transform, lw.transforms.SwapUnmentioned) else lw.canonical_plans(PLANS)
    assert floats(transform(lw.QAFTransform(plans)(rows))) == {torch.float32}
