"""state_dict holds seed and episode counters: an environment that loads it continues with the next episodes."""

import io

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


MAKERS = {
    "plain": make_env,
    "transformed": make_transformed,
    "serial": lambda seed=5: SerialEnv(2, make_transformed, create_env_kwargs={"seed": seed}),
    "outside": lambda seed=5: TransformedEnv(
        SerialEnv(2, make_env, create_env_kwargs={"seed": seed}), lw.QAFTransform(lw.load_plans("MT10"))
    ),
    "parallel": lambda seed=5: TransformedEnv(
        ParallelEnv(2, make_transformed, create_env_kwargs={"seed": seed}, mp_start_method="fork"),
        lw.QAFTransform(lw.load_plans("MT10")),
    ),
    "parallel, no buffers": lambda seed=5: ParallelEnv(
        2,
        make_env,
        create_env_kwargs=[{"seed": seed, "worker": (w, 2)} for w in range(2)],
        mp_start_method="fork",
        use_buffers=False,
    ),
}


def expected_and_actual(make, seed: int) -> tuple[list, list]:
    """Return the third reset of an environment, and of another one that loaded its state before."""
    env, other = make(), make(seed)
    for _ in range(2):
        env.rollout(2)
    other.rollout(1)
    state = torch.load(buffered(env.state_dict()), weights_only=True)
    expected = env.reset()
    other.load_state_dict(state)
    loaded = other.reset()
    still = torch.zeros(*env.batch_size, 4)
    moved = [e.step(td.clone().set("action", still))["next"] for e, td in ((env, expected), (other, loaded))]
    assert torch.equal(moved[0]["observation"], moved[1]["observation"])
    env.close()
    other.close()
    return [expected["episode"], expected["observation"]], [loaded["episode"], loaded["observation"]]


def buffered(state: dict):
    """Save a state as a user does."""
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return file


@pytest.mark.parametrize("name", first_fast(MAKERS, 2))
def test_loading_a_state_continues_with_the_next_episodes(name):
    expected, actual = expected_and_actual(MAKERS[name], seed=77)
    assert expected[0].min() >= 2, "the third episodes"
    assert all(torch.equal(left, right) for left, right in zip(expected, actual, strict=True))


def test_loading_a_state_ends_all_episodes():
    env = make_env()
    state = env.reset()
    env.load_state_dict(env.state_dict())
    with pytest.raises(RuntimeError, match=r"rows \[0, 1, 2\]"):
        env.step(state.set("action", torch.zeros(3, 4)))
    assert env.reset()["episode"].tolist() == [2, 1, 3]
    env.close()


def policy() -> TensorDictModule:
    return TensorDictModule(nn.Linear(39, 4), in_keys=["observation"], out_keys=["action"])


@pytest.mark.parametrize("name", ["transformed", "serial", "outside"])
def test_a_resumed_collector_continues_with_the_next_episodes(name):
    def collector() -> Collector:
        return Collector(
            MAKERS[name](), policy(), frames_per_batch=6 * 5, total_frames=-1, auto_register_policy_transforms=False
        )

    def episodes(batch) -> set[tuple[int, ...]]:
        return set(zip(batch["task_id"].flatten().tolist(), batch["episode"].flatten().tolist(), strict=True))

    first = collector()
    seen = episodes(next(iter(first)))
    saved = first.state_dict()
    first.shutdown()
    second = collector()
    second.load_state_dict(saved)
    second.reset()
    after = episodes(next(iter(second)))
    second.shutdown()
    assert len(after) >= 6
    assert not seen & after


def test_a_collector_continues_after_a_reset():
    """Its reset sets the environment's tensors to zero."""
    actor = lw.PlanConditionedActor(lw.load_plans("MT10"))
    collector = Collector(
        make_transformed(), actor, frames_per_batch=15, total_frames=-1, auto_register_policy_transforms=False
    )
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
