"""What TorchRL's users expect of an environment: actions that last, episodes that end at success, a single one."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from torchrl.envs import SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

import lw_torchrl as lw

PLANS = lw.load_plans("MT10")


def rollout(env, steps, policy=None):
    data = env.rollout(steps, policy or lw.ExpertActor(env.tasks), break_when_any_done=False, auto_cast_to_device=False)
    env.close()
    return data


@pytest.mark.parametrize("reward", ["sparse", "dense"])
def test_an_action_lasts_for_frame_skip_steps(reward):
    options = dict(tasks=["push", "reach"], seed=1, max_steps=20, reward=reward)
    env, plain = lw.LanguageWorldEnv(frame_skip=4, **options), lw.LanguageWorldEnv(**options)
    state, one = env.reset(), plain.reset()
    generator = torch.Generator().manual_seed(0)
    for _ in range(5):
        action = torch.rand(2, 4, generator=generator) * 2 - 1
        state = env.step(state.set("action", action))["next"]
        total, success = torch.zeros(2, 1), torch.zeros(2, 1, dtype=torch.bool)
        for _ in range(4):
            one = plain.step(one.set("action", action))["next"]
            total += one["reward"]
            success |= one["success"]
        assert torch.equal(state["observation"], one["observation"])
        torch.testing.assert_close(state["reward"], total)
        assert torch.equal(state["success"], success)
        assert torch.equal(state["done"], one["done"])
    assert state["truncated"].all()
    env.close()
    plain.close()


def test_the_last_action_is_cut_where_the_episode_ends():
    env, plain = (lw.LanguageWorldEnv("push", max_steps=6, frame_skip=k) for k in (4, 1))
    state, one = env.reset(), plain.reset()
    action = torch.full((1, 4), 0.5)
    for _ in range(2):
        state = env.step(state.set("action", action))["next"]
    for _ in range(6):
        one = plain.step(one.set("action", action))["next"]
    assert torch.equal(state["observation"], one["observation"])
    assert state["truncated"].all()
    env.close()
    plain.close()


def test_an_episode_ends_at_its_first_success():
    found = rollout(lw.LanguageWorldEnv(["push", "reach"], num_envs=4, terminate_on_success=True), 200)["next"]
    plain = rollout(lw.LanguageWorldEnv(["push", "reach"], num_envs=4), 200)["next"]
    assert torch.equal(found["terminated"], found["success"])
    assert torch.equal(found["done"], found["terminated"] | found["truncated"])
    assert not (found["terminated"] & found["truncated"]).any()
    for row in range(4):
        first = int(plain["success"][row].flatten().int().argmax())
        assert int(found["terminated"][row].flatten().int().argmax()) == first
        assert torch.equal(found["observation"][row, : first + 1], plain["observation"][row, : first + 1])
    assert found["episode"].max() > plain["episode"].max(), "a new one begins"


@pytest.mark.parametrize("options", [{}, {"terminate_on_success": True}, {"frame_skip": 3}], ids=str)
def test_a_single_environment_has_no_dimension_of_rows(options):
    env = TransformedEnv(lw.LanguageWorldEnv("reach", batch_size=(), seed=2, **options), lw.QAFTransform(PLANS))
    check_env_specs(env)
    env.set_seed(2)
    data = env.rollout(5, lw.PlanConditionedActor(PLANS))
    assert data.batch_size == (5,)
    assert {key: tuple(data[key].shape) for key in ("observation", "task_id", "action", "qaf", "done")} == {
        "observation": (5, 39),
        "task_id": (5,),
        "action": (5, 4),
        "qaf": (5, PLANS.num_steps),
        "done": (5, 1),
    }
    other = lw.LanguageWorldEnv("reach", num_envs=1, seed=2, **options)
    assert torch.equal(other.reset()["observation"][0], data["observation"][0])
    assert torch.equal(env.reset(episode=3)["episode"], torch.tensor(3))
    env.close()
    other.close()
    make = partial(lw.LanguageWorldEnv, "reach", batch_size=(), **options)
    several = SerialEnv(2, [partial(make, worker=(w, 2)) for w in range(2)])
    assert several.rollout(3)["episode"].tolist() == [[0] * 3, [1] * 3]
    several.close()
