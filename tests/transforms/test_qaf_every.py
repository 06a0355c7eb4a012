"""QAFTransform(every=k, delay=d): answers that are taken now and then, and come late."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from random_states import PLANS, RandomStates
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, EnvBase, ParallelEnv, SerialEnv, TransformedEnv, check_env_specs

import lw_torchrl as lw
from lw_torchrl.transforms.environment import DelayedAnswers

ROWS = 4


def both(env: EnvBase, every: int, delay: int) -> TransformedEnv:
    """The environment with the exact answers beside the held ones."""
    exact = lw.QAFTransform(PLANS, out_keys=["exact"])
    return TransformedEnv(env, Compose(exact, lw.QAFTransform(PLANS, every=every, delay=delay)))


def expected(exact: list[Tensor], every: int, delay: int) -> Tensor:
    """What is shown in the last step of an episode with these exact answers."""
    taken = exact[0]
    for step, now in enumerate(exact[: max(len(exact) - 1 - delay, 0) + 1]):
        if step % every == 0:
            taken = now
    return taken


def check_rollout(rollout: TensorDictBase, every: int, delay: int) -> int:
    """Compare each state of (..., T) with the plain reference; returns how many differ from the exact answers."""
    flat, late = rollout.reshape(-1, rollout.shape[-1]), 0
    for row in flat:
        episode: list[Tensor] = []
        for step in row:
            if not episode:
                episode = [step["exact"]]
                assert torch.equal(step["qaf"], step["exact"]), "an episode begins with its own answers"
            assert torch.equal(step["qaf"], expected(episode, every, delay))
            late += int(not torch.equal(step["qaf"], step["exact"]))
            episode.append(step["next", "exact"])
            assert torch.equal(step["next", "qaf"], expected(episode, every, delay))
            if step["next", "done"].any():
                episode = []
    return late


masks = st.lists(st.booleans(), min_size=ROWS, max_size=ROWS).map(torch.tensor)
moves = st.lists(st.tuples(st.sampled_from(["step", "step", "step", "reset"]), masks), max_size=25)


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 6), st.integers(0, 7), moves)
def test_it_is_what_a_plain_program_gives_over_any_resets(every, delay, done):
    env = both(RandomStates(ROWS), every, delay)
    state = env.reset()
    episodes = [[one] for one in state["exact"]]
    for kind, mask in done:
        if kind == "reset":
            if not mask.any():
                continue
            state = env.reset(state.set("_reset", mask))
        else:
            state = env.step(state.set("action", torch.zeros(ROWS, 4)).set("_step", mask))["next"]
        for row in mask.nonzero().flatten().tolist():
            episodes[row] = [*([] if kind == "reset" else episodes[row]), state["exact"][row]]
        for row in range(ROWS):
            assert torch.equal(state["qaf"][row], expected(episodes[row], every, delay)), (row, kind)


@pytest.mark.parametrize(("every", "delay"), [(1, 0), (3, 0), (1, 4), (3, 2), (50, 0), (2, 9)])
def test_rollouts_that_reset_themselves(every, delay):
    env = both(RandomStates(ROWS, length=7), every, delay)
    late = check_rollout(env.rollout(30, break_when_any_done=False), every, delay)
    assert (late > 0) == ((every, delay) != (1, 0))


@pytest.mark.parametrize("place", ["inside", "outside"])
def test_workers_of_a_serial_env(place):
    if place == "inside":
        env = SerialEnv(2, [lambda: both(RandomStates(2, 5), 3, 1), lambda: both(RandomStates(2, 6, first=2), 3, 1)])
    else:
        env = both(SerialEnv(2, [lambda: RandomStates(2, 5), lambda: RandomStates(2, 6, first=2)]), 3, 1)
    assert check_rollout(env.rollout(25, break_when_any_done=False), 3, 1) > 0
    env.close()


def make(every: int, delay: int) -> TransformedEnv:
    return both(RandomStates(2, 5), every, delay)


@pytest.mark.slow
@pytest.mark.parametrize("place", ["inside", "outside"])
def test_workers_of_a_parallel_env(place):
    if place == "inside":
        env = ParallelEnv(2, partial(make, 3, 1), mp_start_method="fork")
    else:
        env = both(ParallelEnv(2, partial(RandomStates, 2, 5), mp_start_method="fork"), 3, 1)
    assert check_rollout(env.rollout(25, break_when_any_done=False), 3, 1) > 0
    env.close()


def test_a_collector():
    env = both(RandomStates(ROWS, 7), 4, 2)
    collector = Collector(
        env, None, frames_per_batch=ROWS * 10, total_frames=ROWS * 30, auto_register_policy_transforms=False
    )
    batches = torch.cat([batch.clone() for batch in collector], -1)
    collector.shutdown()
    assert batches.shape == (ROWS, 30)
    assert check_rollout(batches, 4, 2) > 0


def test_the_specs_know_it():
    env = both(lw.LanguageWorldEnv(["push", "reach"], num_envs=3, max_steps=6), 2, 1)
    check_env_specs(env)
    env.close()


def test_a_single_environment_without_rows():
    env = both(lw.LanguageWorldEnv("reach", batch_size=(), max_steps=4), 3, 1)
    assert check_rollout(env.rollout(9, break_when_any_done=False), 3, 1) >= 0
    env.close()


def test_exact_answers_are_what_they_were():
    found, plain = (
        TransformedEnv(RandomStates(ROWS, 6), lw.QAFTransform(PLANS, **options)).rollout(20, break_when_any_done=False)
        for options in ({"every": 1, "delay": 0}, {})
    )
    assert torch.equal(found["qaf"], plain["qaf"])
    assert torch.equal(found["qaf"], lw.QAFTransform(PLANS)(plain.select("observation", "task_id"))["qaf"])


# --- what resumes --------------------------------------------------------------------------------------------------


def walk(env: EnvBase, steps: int) -> TensorDictBase:
    return env.rollout(steps, lambda td: td.set("action", torch.full((2, 4), 0.5)), break_when_any_done=False)


def test_a_loaded_state_wants_a_reset_and_then_goes_on_bit_for_bit():
    whole, first, second = (both(lw.LanguageWorldEnv(["push", "reach"], seed=3, max_steps=9), 4, 1) for _ in range(3))
    walk(first, 5)
    second.reset()
    state = second.reset()
    second.load_state_dict(first.state_dict())
    with pytest.raises(RuntimeError, match="reset"):
        second.step(state.set("action", torch.zeros(2, 4)))
    walk(whole, 5)
    expect, found = walk(whole, 12), walk(second, 12)
    assert (found["episode"][:, 0] == 1).all()
    for key in ("qaf", "observation", "episode", ("next", "qaf")):
        assert torch.equal(found[key], expect[key]), key
    for env in (whole, first, second):
        env.close()


def test_answers_under_way_do_not_outlive_a_loaded_state():
    """Also over an environment that does not ask for a reset itself."""
    held = DelayedAnswers(every=2)
    with pytest.raises(RuntimeError, match="reset the environment"):
        held.advance(torch.zeros(2, 3, dtype=torch.bool), None)
    env = TransformedEnv(RandomStates(2), lw.QAFTransform(PLANS, every=2))
    state = env.reset()
    env.load_state_dict(env.state_dict())
    with pytest.raises(RuntimeError, match=r"not since load_state_dict.*reset the environment"):
        env.step(state.set("action", torch.zeros(2, 4)))


def test_a_clone_shares_no_answers():
    transform = lw.QAFTransform(PLANS, every=3)
    env, other = TransformedEnv(RandomStates(2), transform), TransformedEnv(RandomStates(2), transform.clone())
    state = env.reset()
    other.reset()
    for _ in range(2):
        other.step(other.reset().set("action", torch.zeros(2, 4)))
    after = env.step(state.clone().set("action", torch.zeros(2, 4)))["next"]
    assert torch.equal(after["qaf"], state["qaf"])


# --- bad input -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [{"every": 2}, {"delay": 1}])
def test_a_replay_buffer_is_refused(options):
    rows = TransformedEnv(RandomStates(2), lw.QAFTransform(PLANS)).rollout(3).flatten()
    replay = TensorDictReplayBuffer(
        storage=LazyTensorStorage(6), transform=lw.QAFTransform(PLANS, **options), batch_size=6
    )
    replay.extend(rows)
    with pytest.raises(ValueError, match="rows of a replay buffer do not tell: put it into the environment"):
        replay.sample()


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"every": 0}, ValueError, "every must be at least 1, got 0"),
        ({"delay": -1}, ValueError, "delay must be at least 0, got -1"),
        ({"every": 2.5}, TypeError, "every must be an integer, got 2.5"),
    ],
)
def test_wrong_numbers_are_named(options, error, message):
    with pytest.raises(error, match=message):
        lw.QAFTransform(PLANS, **options)


def test_an_evaluation_with_it_in_the_exact_answers_place():
    plans = lw.load_plans("MT10")
    actor, seen = lw.ScriptedSkillActor(plans), []
    lw.evaluate(
        actor,
        tasks=["drawer-open", "reach"],
        episodes_per_task=2,
        seed=7,
        max_steps=40,
        num_envs=2,
        also_record=["qaf", "observation", "task_id"],
        on_episode=seen.append,
        evaluator=lw.QAFTransform(plans, every=5, delay=2),
    )
    late = 0
    assert len(seen) == 4
    for one in seen:
        exact = lw.QAFTransform(plans)(one.steps.select("observation", "task_id"))["qaf"]
        for step in range(len(one.steps)):
            assert torch.equal(one.steps["qaf"][step], expected(list(exact[: step + 1]), 5, 2))
        late += int((one.steps["qaf"] != exact).any())
    assert late > 0
