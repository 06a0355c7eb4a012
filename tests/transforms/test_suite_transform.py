"""SuiteTransform: numbers of the previous step, the task, actions of a layout."""

import torch
from torchrl.envs import Compose, TransformedEnv, check_env_specs

import lw_torchrl as lw
from lw_torchrl.transforms import SuiteTransform

PUSH = lw.TASKS["push"]


def forgetful(observation):
    """Return Meta-World's numbers without those of the previous step."""
    seen = observation.clone()
    seen[..., 18:36] = torch.nan
    return seen


def make(*more, **options):
    return TransformedEnv(
        lw.LanguageWorldEnv("push", num_envs=2, max_steps=9), Compose(SuiteTransform(PUSH, forgetful, **options), *more)
    )


def test_numbers_of_the_previous_step_are_filled_in():
    env = make()
    check_env_specs(env)
    rollout = env.rollout(9)
    env.close()
    seen = rollout["next", "observation"]
    assert torch.equal(seen[..., 18:36], rollout["observation"][..., :18])
    first = rollout["observation"][:, 0]
    assert torch.equal(first[:, 18:36], first[:, :18]), "at a reset they are those of now"
    assert (rollout["task_id"] == lw.task_id("push")).all()


def test_action_is_converted_only_for_the_environment():
    env = make(act=lambda action: -action)
    state = env.reset()
    state["action"] = torch.tensor([[0.5, -0.25, 0.0, 1.0]] * 2)
    after = env.step(state)
    assert torch.equal(after["next", "executed_action"], -state["action"])
    assert torch.equal(after["action"], state["action"])
    assert env.action_spec.shape == (2, 4)
    env.close()
