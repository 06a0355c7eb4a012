"""state_dict holds seed and episode counters: an environment that loads it continues with the next episodes."""

import io
from functools import partial

import pytest
import torch
from speed import first_fast
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import Compose, ParallelEnv, SerialEnv, StepCounter, TransformedEnv

import lw_torchrl as lw

TASKS = ["push", "reach"]
pytestmark = pytest.mark.filterwarnings("ignore:No explicit `?device")


def make_env(seed: int = 5, **options) -> lw.LanguageWorldEnv:
    return lw.LanguageWorldEnv(TASKS, num_envs=3, seed=seed, max_steps=4, num_threads=1, **options)


def make_transformed(seed: int = 5) -> TransformedEnv:
    return TransformedEnv(make_env(seed), Compose(lw.QAFTransform(lw.load_plans("MT10")), StepCounter()))


def transformed(env) -> TransformedEnv:
    return TransformedEnv(env, lw.QAFTransform(lw.load_plans("MT10")))


FORK = {"mp_start_method": "fork"}
MAKERS = {
    "plain": make_env,
    "transformed": make_transformed,
    "serial": lambda seed=5: SerialEnv(2, make_transformed, create_env_kwargs={"seed": seed}),
    "outside": lambda seed=5: transformed(SerialEnv(2, make_env, create_env_kwargs={"seed": seed})),
    "parallel": lambda seed=5: transformed(ParallelEnv(2, make_transformed, create_env_kwargs={"seed": seed}, **FORK)),
    "parallel, no buffers": lambda seed=5: ParallelEnv(
        2, [partial(make_env, seed, worker=(w, 2)) for w in range(2)], use_buffers=False, **FORK
    ),
}


@pytest.mark.parametrize("name", first_fast(MAKERS, 2))
def test_loading_a_state_continues_with_the_next_episodes(name):
    env, other = MAKERS[name](), MAKERS[name](77)
    for _ in range(2):
        env.rollout(2)
    other.rollout(1)
    torch.save(env.state_dict(), file := io.BytesIO())
    file.seek(0)
    other.load_state_dict(torch.load(file, weights_only=True))
    expected, loaded = env.reset(), other.reset()
    assert expected["episode"].min() >= 2, "the third episodes"
    still = torch.zeros(*env.batch_size, 4)
    moved = [each.step(td.clone().set("action", still)) for each, td in ((env, expected), (other, loaded))]
    for key in ("episode", "observation", ("next", "observation")):
        assert torch.equal(moved[0][key], moved[1][key])
    env.close()
    other.close()


def test_loading_a_state_ends_all_episodes():
    env = make_env()
    state = env.reset()
    env.load_state_dict(env.state_dict())
    with pytest.raises(RuntimeError, match=r"rows \[0, 1, 2\]"):
        env.step(state.set("action", torch.zeros(3, 4)))
    assert env.reset()["episode"].tolist() == [2, 1, 3]
    env.close()


def make_collector(make, policy) -> Collector:
    return Collector(make(), policy, frames_per_batch=30, total_frames=-1, auto_register_policy_transforms=False)


@pytest.mark.parametrize("name", ["transformed", "serial", "outside"])
def test_a_resumed_collector_continues_with_the_next_episodes(name):
    def episodes(collector) -> set[tuple[int, int]]:
        batch = next(iter(collector))
        return set(zip(batch["task_id"].flatten().tolist(), batch["episode"].flatten().tolist(), strict=True))

    first, second = (
        make_collector(MAKERS[name], TensorDictModule(nn.Linear(39, 4), ["observation"], ["action"])) for _ in range(2)
    )
    seen = episodes(first)
    second.load_state_dict(first.state_dict())
    second.reset()
    after = episodes(second)
    for collector in (first, second):
        collector.shutdown()
    assert len(after) >= 6
    assert not seen & after


def test_a_collector_continues_after_a_reset():
    """Its reset sets the environment's tensors to zero."""
    collector = make_collector(make_transformed, lw.PlanConditionedActor(lw.load_plans("MT10")))
    for _ in range(2):
        assert next(iter(collector))["qaf_plan"].all()
        collector.reset()
    collector.shutdown()


@pytest.mark.parametrize(("tasks", "num_envs"), [(TASKS, 4), (["push", "sweep"], 3)])
def test_a_state_of_other_rows_is_an_error(tasks, num_envs):
    env, foreign = make_env(), lw.LanguageWorldEnv(tasks, num_envs=num_envs, num_threads=1)
    env.reset()
    with pytest.raises(ValueError, match=f"state_dict .* other rows: {num_envs} rows"):
        env.load_state_dict(foreign.state_dict())
    assert (env.seed, env.reset()["episode"].tolist()) == (5, [2, 1, 3]), "the state must not change"
    env.close()
    foreign.close()


def test_a_transform_of_a_buffer_has_no_environments_state():
    transform = lw.QAFTransform(lw.load_plans("MT10"))
    state = transform.state_dict()
    transform.load_state_dict(state)
    env = make_transformed()
    with pytest.raises(ValueError, match="lacks episode counters"):
        env.transform[0].load_state_dict(state)
    env.close()
