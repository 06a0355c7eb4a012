"""LanguageWorldEnv with TorchRL: frame skip, early ends, a single environment, ids in every shape."""

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
def test_frame_skip_repeats_an_action_until_the_end_of_the_episode(reward):
    options = dict(tasks=["push", "reach"], seed=1, max_steps=18, reward=reward)
    env, plain = lw.LanguageWorldEnv(frame_skip=4, **options), lw.LanguageWorldEnv(**options)
    state, single = env.reset(), plain.reset()
    generator = torch.Generator().manual_seed(0)
    for length in (4, 4, 4, 4, 2):
        action = torch.rand(2, 4, generator=generator) * 2 - 1
        state = env.step(state.set("action", action))["next"]
        total, success = torch.zeros(2, 1), torch.zeros(2, 1, dtype=torch.bool)
        for _ in range(length):
            single = plain.step(single.set("action", action))["next"]
            total += single["reward"]
            success |= single["success"]
        torch.testing.assert_close(state["reward"], total)
        assert torch.equal(state["success"], success)
        assert all(torch.equal(state[key], single[key]) for key in ("observation", "done"))
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
    shapes = {"observation": (5, 39), "task_id": (5,), "action": (5, 4), "qaf": (5, PLANS.num_steps), "done": (5, 1)}
    assert {key: tuple(data[key].shape) for key in shapes} == shapes
    other = lw.LanguageWorldEnv("reach", num_envs=1, seed=2, **options)
    assert torch.equal(other.reset()["observation"][0], data["observation"][0])
    assert env.reset(episode=3)["episode"] == torch.tensor(3)
    make = partial(lw.LanguageWorldEnv, "reach", batch_size=(), **options)
    several = SerialEnv(2, [partial(make, worker=(w, 2)) for w in range(2)])
    assert several.rollout(3)["episode"].tolist() == [[0] * 3, [1] * 3]
    for each in (env, other, several):
        each.close()


def test_ids_of_a_spec_keep_their_rows_in_every_shape():
    """TorchRL calls policies on the zeros of a spec to find out what they write."""
    env = TransformedEnv(lw.LanguageWorldEnv(["push", "reach"], num_envs=3), lw.QAFTransform(PLANS))
    spec = env.observation_spec["task_id"]
    ids = spec.zero()
    for changed, expected in (
        (spec.clone(), ids),
        (spec.to("cpu"), ids),
        (spec.expand(2, 3), ids.expand(2, 3)),
        (spec.unsqueeze(0), ids.unsqueeze(0)),
        (spec.unsqueeze(0).squeeze(0), ids),
        (spec[1:], ids[1:]),
        (spec.reshape(3, 1), ids.reshape(3, 1)),
        (spec.unflatten(0, (3, 1)), ids.reshape(3, 1)),
    ):
        assert torch.equal(changed.zero(), expected)
    assert torch.equal(spec.zero((2,)), ids.expand(2, 3))
