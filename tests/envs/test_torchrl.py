"""LanguageWorldEnv with TorchRL: frame skip, early ends, a single environment, ids in every shape."""

from functools import partial

import pytest
import torch
from torchrl.envs import (
    SerialEnv,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs

import lw_torchrl as lw

PLANS = lw.load_plans("MT10")


def rollout(env, steps, policy=None):
    data = env.rollout(steps, policy or lw.ExpertActor(env.tasks), break_when_any_done=False, auto_cast_to_device=False)
    env.close()
    return data


@pytest.mark.parametrize("reward", ["sparse", "dense"])
def test_frame_skip_repeats_an_action(reward):
    options = dict(tasks=["push", "reach"], seed=1, max_steps=20, reward=reward)
    env, plain = lw.LanguageWorldEnv(frame_skip=4, **options), lw.LanguageWorldEnv(**options)
    state, single = env.reset(), plain.reset()
    generator = torch.Generator().manual_seed(0)
    for _ in range(5):
        action = torch.rand(2, 4, generator=generator) * 2 - 1
        state = env.step(state.set("action", action))["next"]
        total, success = torch.zeros(2, 1), torch.zeros(2, 1, dtype=torch.bool)
        for _ in range(4):
            single = plain.step(single.set("action", action))["next"]
            total += single["reward"]
            success |= single["success"]
        assert torch.equal(state["observation"], single["observation"])
        torch.testing.assert_close(state["reward"], total)
        assert torch.equal(state["success"], success)
        assert torch.equal(state["done"], single["done"])
    assert state["truncated"].all()
    env.close()
    plain.close()


def test_frame_skip_stops_at_the_end_of_an_episode():
    env, plain = (lw.LanguageWorldEnv("push", max_steps=6, frame_skip=k) for k in (4, 1))
    state, single = env.reset(), plain.reset()
    action = torch.full((1, 4), 0.5)
    for _ in range(2):
        state = env.step(state.set("action", action))["next"]
    for _ in range(6):
        single = plain.step(single.set("action", action))["next"]
    assert torch.equal(state["observation"], single["observation"])
    assert state["truncated"].all()
    env.close()
    plain.close()


def test_terminate_on_success_ends_an_episode():
    ending = rollout(lw.LanguageWorldEnv(["push", "reach"], num_envs=4, terminate_on_success=True), 200)["next"]
    plain = rollout(lw.LanguageWorldEnv(["push", "reach"], num_envs=4), 200)["next"]
    assert torch.equal(ending["terminated"], ending["success"])
    assert torch.equal(ending["done"], ending["terminated"] | ending["truncated"])
    assert not (ending["terminated"] & ending["truncated"]).any()
    for row in range(4):
        first = int(plain["success"][row].flatten().int().argmax())
        assert int(ending["terminated"][row].flatten().int().argmax()) == first
        assert torch.equal(ending["observation"][row, : first + 1], plain["observation"][row, : first + 1])
    assert ending["episode"].max() > plain["episode"].max(), "the next episode begins"


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


# ---- fake data, on which TorchRL calls policies to find out what they write


def make_env(tasks=("push", "reach")):
    return TransformedEnv(lw.LanguageWorldEnv(tasks, num_envs=3), lw.QAFTransform(PLANS))


def test_ids_of_a_spec_keep_their_rows_in_every_shape():
    spec = make_env().observation_spec["task_id"]
    ids = spec.zero()
    assert torch.equal(spec.clone().zero(), ids)
    assert torch.equal(spec.expand(2, 3).zero(), ids.expand(2, 3))
    assert torch.equal(spec.unsqueeze(0).zero(), ids.unsqueeze(0))
    assert torch.equal(spec.unsqueeze(0).squeeze(0).zero(), ids)
    assert torch.equal(spec[1:].zero(), ids[1:])
    assert torch.equal(spec.reshape(3, 1).zero(), ids.reshape(3, 1))
    assert torch.equal(spec.unflatten(0, (3, 1)).zero(), ids.reshape(3, 1))
    assert torch.equal(spec.to("cpu").zero(), ids)
    assert torch.equal(spec.zero((2,)), ids.expand(2, 3))
