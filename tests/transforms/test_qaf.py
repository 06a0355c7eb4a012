"""QAFTransform writes what QueryProgram answers, in an environment and on a replay buffer."""

from collections.abc import Iterator

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs import Compose, StepCounter, TransformedEnv

import lw_torchrl as lw

PLANS = lw.load_plans("MT10")
TASKS = ["button-press-topdown", "door-open", "drawer-open", "push"]  # plans of 3, 5, 3 and 4 steps
ROWS, STEPS, WIDTH = 6, 60, 5


@pytest.fixture(scope="module")
def few_plans() -> lw.Plans:
    return lw.Plans({task: PLANS[task] for task in TASKS})


@pytest.fixture(scope="module")
def env(few_plans) -> Iterator[TransformedEnv]:
    env = TransformedEnv(lw.LanguageWorldEnv(TASKS, num_envs=ROWS, seed=0, max_steps=STEPS), lw.QAFTransform(few_plans))
    yield env
    env.close()


@pytest.fixture(scope="module")
def rollout(env) -> TensorDictBase:
    """Return an episode of the experts and the beginning of the next."""
    env.set_seed(0)
    return env.rollout(STEPS + 5, lw.ExpertActor(TASKS), break_when_any_done=False)


def answers(observation: Tensor, task_id: Tensor) -> Tensor:
    """Answer each condition of each row by a separate program, one state at a time."""
    states, tasks = observation.reshape(-1, 39), task_id.reshape(-1)
    result = torch.zeros(len(states), WIDTH, dtype=torch.bool)
    for task in TASKS:
        rows = torch.nonzero(tasks == lw.task_id(task)).flatten()
        for number, step in enumerate(PLANS[task].steps):
            program = lw.QueryProgram({task: [step.condition]})
            for row in rows.tolist():
                result[row, number] = program(states[row : row + 1], tasks[row : row + 1]).item()
    return result.reshape(*task_id.shape, WIDTH)


def test_answers_are_the_programs_at_every_step(rollout):
    expected = answers(rollout["observation"], rollout["task_id"])
    assert torch.equal(rollout["qaf"], expected)
    assert torch.equal(rollout["next", "qaf"], answers(rollout["next", "observation"], rollout["next", "task_id"]))
    for task in TASKS:
        rows = rollout["qaf"][rollout["task_id"][:, 0] == lw.task_id(task)].flatten(0, 1)
        assert not rows[:, len(PLANS[task].steps) :].any(), "padding is false"
        assert rows[:, 0].unique().tolist() == [False, True], task
    ended = rollout["next", "done"].squeeze(-1)
    assert ended.sum() == ROWS
    assert not torch.equal(rollout["qaf"][:, STEPS], rollout["next", "qaf"][:, STEPS - 1]), "a reset answers afresh"


def test_masked_rows_keep_their_answers(env):
    env.set_seed(0)
    state = env.reset()
    mask = torch.arange(ROWS) % 2 == 0
    expert = lw.ExpertActor(TASKS)
    for _ in range(50):
        state = env.step(expert(state).set("_step", mask))["next"]
    fresh = env.reset(state.clone().set("_reset", mask))
    env.set_seed(0)
    first = env.reset()
    assert torch.equal(state["qaf"][~mask], first["qaf"][~mask])
    assert not torch.equal(state["qaf"][mask], first["qaf"][mask])
    assert torch.equal(fresh["qaf"][~mask], state["qaf"][~mask])
    assert torch.equal(fresh["qaf"], answers(fresh["observation"], fresh["task_id"]))


def buffer(data: TensorDictBase, plans: lw.Plans) -> TensorDictReplayBuffer:
    """Return a buffer whose samples hold every row once, in some order."""
    parts = {"sampler": SamplerWithoutReplacement(), "transform": lw.QAFTransform(plans)}
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(len(data)), batch_size=len(data), **parts)
    replay.extend(data)
    return replay


STORED = ("observation", "task_id", "action", ("next", "observation"), ("next", "task_id"), ("next", "reward"))


@pytest.mark.parametrize("next_task_id", [True, False])
def test_answers_on_a_replay_buffer(rollout, few_plans, next_task_id):
    data = rollout.select(*STORED).flatten(0, 1)
    if not next_task_id:
        data = data.exclude(("next", "task_id"))
    without = buffer(data.exclude(("next", "observation")), few_plans).sample()
    assert ("next", "qaf") not in without.keys(True)
    sample = buffer(data, few_plans).sample()
    assert torch.equal(sample["qaf"], answers(sample["observation"], sample["task_id"]))
    assert torch.equal(sample["next", "qaf"], answers(sample["next", "observation"], sample["task_id"]))
    assert not torch.equal(sample["qaf"], sample["next", "qaf"])
    assert (("next", "task_id") in sample.keys(True)) == next_task_id


def test_any_leading_shape(rollout, few_plans):
    transform, data = lw.QAFTransform(few_plans), rollout.select(*STORED)
    for output, expected in ((transform(data.clone()), rollout), (transform(data[2, 7].clone()), rollout[2, 7])):
        assert torch.equal(output["qaf"], expected["qaf"])
        assert torch.equal(output["next", "qaf"], expected["next", "qaf"])


def test_task_without_a_plan_is_refused_at_once(few_plans):
    env = lw.LanguageWorldEnv(["push", "sweep", "soccer"])
    for build in (
        lambda: TransformedEnv(env, Compose(StepCounter(), Compose(lw.QAFTransform(few_plans)))),
        lambda: TransformedEnv(env, StepCounter()).append_transform(lw.QAFTransform(few_plans)),
    ):
        with pytest.raises(lw.PlanError, match="soccer, sweep"):
            build()
    env.close()
