"""An environment's state is its seed and episode counters: what loads it goes on with the next episodes."""

from __future__ import annotations

import copy
import io
import pickle

import pytest
import torch
from speed import first_fast
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import Compose, EnvBase, EnvCreator, ParallelEnv, SerialEnv, StepCounter, TransformedEnv

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
    "EnvState": lambda seed=5: TransformedEnv(make_env(seed), lw.transforms.EnvState()),
    "serial": lambda seed=5: SerialEnv(2, make_transformed, create_env_kwargs={"seed": seed}),
    "outside": lambda seed=5: TransformedEnv(
        SerialEnv(2, make_env, create_env_kwargs={"seed": seed}), lw.QAFTransform(lw.load_plans("MT10"))
    ),
    "parallel": lambda seed=5: TransformedEnv(
        ParallelEnv(2, make_transformed, create_env_kwargs={"seed": seed}, mp_start_method="fork"),
        lw.transforms.EnvState(),
    ),
    "parallel, no buffers": lambda seed=5: ParallelEnv(
        2,
        make_env,
        create_env_kwargs=[{"seed": seed, "worker": (w, 2)} for w in range(2)],
        mp_start_method="fork",
        use_buffers=False,
    ),
}


def expected_and_got(make, seed: int) -> tuple[list, list]:
    """What comes after two resets, in the environment itself, and in another that took its state."""
    env, other = make(), make(seed)
    for _ in range(2):
        env.rollout(2)
    other.rollout(1)
    state = torch.load(buffered(env.state_dict()), weights_only=True)
    expected = env.reset()
    other.load_state_dict(state)
    got = other.reset()
    still = torch.zeros(*env.batch_size, 4)
    moved = [e.step(td.clone().set("action", still))["next"] for e, td in ((env, expected), (other, got))]
    assert torch.equal(moved[0]["observation"], moved[1]["observation"])
    env.close()
    other.close()
    return [expected["episode"], expected["observation"]], [got["episode"], got["observation"]]


def buffered(state: dict):
    """Saved as a user would."""
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return file


@pytest.mark.parametrize("name", first_fast(MAKERS, 2))
def test_what_loads_the_state_goes_on(name):
    expected, got = expected_and_got(MAKERS[name], seed=77)
    assert expected[0].min() >= 2, "the third episodes"
    assert all(torch.equal(left, right) for left, right in zip(expected, got, strict=True))


def test_the_episodes_that_ran_are_over():
    env = make_env()
    state = env.reset()
    env.load_state_dict(env.state_dict())
    with pytest.raises(RuntimeError, match=r"rows \[0, 1, 2\] .* not since close or load_state_dict: reset them"):
        env.step(state.set("action", torch.zeros(3, 4)))
    assert env.reset()["episode"].tolist() == [2, 1, 3]
    env.close()


def policy() -> TensorDictModule:
    return TensorDictModule(nn.Linear(39, 4), in_keys=["observation"], out_keys=["action"])


@pytest.mark.parametrize("name", ["transformed", "EnvState", "serial", "outside"])
def test_a_resumed_collector_goes_on(name):
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


def test_a_collector_goes_on_after_a_reset_with_a_policy_of_plans():
    """It zeroes what the environment gave it."""
    actor = lw.PlanConditionedActor(lw.load_plans("MT10"))
    collector = Collector(
        make_transformed(), actor, frames_per_batch=15, total_frames=-1, auto_register_policy_transforms=False
    )
    for _ in range(2):
        assert next(iter(collector))["qaf_plan"].all()
        collector.reset()
    collector.shutdown()


def test_nothing_that_is_given_is_kept():
    env = make_transformed()
    first, second = env.reset(), env.reset()
    for key in first.keys(True, True):
        assert first[key].data_ptr() != second[key].data_ptr(), key
    env.close()


def test_a_collector_of_a_plain_environment_says_that_it_saves_nothing():
    first = Collector(make_env(), policy(), frames_per_batch=3, total_frames=-1, auto_register_policy_transforms=False)
    saved = first.state_dict()
    with pytest.raises(ValueError, match=r"state_dict is empty: a Collector saves .* only in a TransformedEnv"):
        first.load_state_dict(saved)
    saved["env_state_dict"] = first.env.state_dict()
    first.load_state_dict(saved)
    first.shutdown()


def test_an_env_creator_changes_nothing():
    plain = make_transformed()
    expected = plain.reset()["episode"]
    plain.close()
    env = EnvCreator(make_transformed)()
    assert torch.equal(env.reset()["episode"], expected)
    env.close()


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (lambda: lw.LanguageWorldEnv(TASKS, num_envs=4, num_threads=1), "other rows, 4: push, reach, push, reach"),
        (lambda: lw.LanguageWorldEnv(["push", "sweep"], num_envs=3, num_threads=1), "other rows, 3: push, sweep, push"),
    ],
    ids=["rows", "tasks"],
)
def test_a_state_of_other_rows_is_refused(other, message):
    env, foreign = make_env(), other()
    env.reset()
    with pytest.raises(ValueError, match=f"state_dict is of an environment with {message}"):
        env.load_state_dict(foreign.state_dict())
    assert (env.seed, env.reset()["episode"].tolist()) == (5, [2, 1, 3]), "nothing was taken"
    env.close()
    foreign.close()


def test_it_is_a_modules_state_like_any_other():
    class Agent(nn.Module):
        def __init__(self, env: EnvBase) -> None:
            super().__init__()
            self.env, self.layer = env, nn.Linear(2, 2)

    one, two = Agent(make_env()), Agent(make_env(6))
    one.env.reset()
    assert set(one.state_dict()) == {"env._extra_state", "layer.weight", "layer.bias"}
    assert not list(one.env.parameters())
    two.load_state_dict(one.state_dict())
    assert (two.env.seed, two.env.reset()["episode"].tolist()) == (5, [2, 1, 3])
    one.env.load_state_dict({}, strict=False)
    assert one.env.reset()["episode"].tolist() == [2, 1, 3], "nothing was asked of it"
    one.env.close()
    two.env.close()


def test_on_a_replay_buffer_there_is_no_environment():
    transform = lw.QAFTransform(lw.load_plans("MT10"))
    state = transform.state_dict()
    transform.load_state_dict(state)
    env = make_transformed()
    with pytest.raises(ValueError, match="lacks an environment's episodes"):
        env.transform[0].load_state_dict(state)
    env.close()


def test_a_closed_batch_says_that_its_state_is_gone():
    env = MAKERS["outside"]()
    env.reset()
    env.close()
    with pytest.warns(UserWarning, match="this SerialEnv is not running"):
        env.state_dict()


@pytest.mark.parametrize("copier", [copy.copy, copy.deepcopy, pickle.dumps], ids=lambda f: f.__name__)
@pytest.mark.parametrize("make", [make_env, make_transformed])
def test_neither_a_copy_nor_a_pickle(copier, make):
    env = make()
    if not (copier is copy.copy and make is make_transformed):
        with pytest.raises(TypeError, match="can be neither pickled nor copied: pass a function that makes it"):
            copier(env)
    env.close()
