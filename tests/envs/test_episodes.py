"""run_episodes: exactly the requested episodes, and the same results on any number of rows."""

from collections.abc import Callable, Iterator
from functools import cache

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from speed import first_fast
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs import TransformedEnv

import lw_torchrl as lw
from lw_torchrl._util.devices import in_blocks
from lw_torchrl.envs.episodes import run_episodes
from lw_torchrl.envs.rows import action_noise

TASKS = ["push", "reach"]
SEED, STEPS = 3, 8
KEYS = ["observation", "task_id", "episode", "action", ("next", "observation"), ("next", "reward"), ("next", "done")]


@cache
def plain_env(num_envs: int, max_steps: int = STEPS) -> lw.LanguageWorldEnv:
    return lw.LanguageWorldEnv(TASKS, num_envs=num_envs, seed=SEED, max_steps=max_steps, reward="dense")


@cache
def transformed_env(num_envs: int, max_steps: int = STEPS) -> TransformedEnv:
    return TransformedEnv(plain_env.__wrapped__(num_envs, max_steps), lw.QAFTransform(lw.load_plans("MT10")))


@pytest.fixture(scope="module", autouse=True)
def close() -> Iterator[None]:
    yield
    plain_env.cache_clear()
    transformed_env.cache_clear()


def wavy(tensordict: TensorDictBase) -> TensorDictBase:
    """Act by an element-wise function, whose result cannot depend on the number of rows."""
    return tensordict.set("action", (tensordict["observation"][..., :4] * 37).sin())


@pytest.fixture(scope="module")
def network() -> Callable[[TensorDictBase], TensorDictBase]:
    """A small network, whose matrix products depend on the number of rows in the last bits."""
    torch.manual_seed(0)
    layers = nn.Sequential(nn.Linear(39, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU(), nn.Linear(256, 4), nn.Tanh())
    return TensorDictModule(layers, in_keys=["observation"], out_keys=["action"])


@cache
def expected_steps(task: str, episode: int) -> TensorDictBase:
    """Run an episode with ``wavy`` in an environment of one row."""
    env = lw.LanguageWorldEnv(task, seed=SEED, max_steps=STEPS, reward="dense")
    state = env.reset(episode=episode)
    steps = []
    for _ in range(STEPS):
        steps.append(env.step(wavy(state)).clone())
        state = steps[-1]["next"].exclude("reward")
    env.close()
    return torch.cat(steps).select(*KEYS)


def run(env, policy, episodes, **options) -> dict[tuple[str, int], TensorDictBase]:
    """Return (task, episode) to the recorded steps; no episode may come twice."""
    options.setdefault("keys", KEYS)
    recorded: dict[tuple[str, int], TensorDictBase] = {}
    with torch.no_grad():
        for task, episode, steps in run_episodes(env, policy, episodes, **options):
            assert (task, episode) not in recorded
            recorded[task, episode] = steps
    return recorded


def pairs(episodes: dict[str, list[int]]) -> set[tuple[str, int]]:
    return {(task, episode) for task, listed in episodes.items() for episode in listed}


LISTS = st.lists(st.integers(0, 12), unique=True, max_size=5)


@given(
    episodes=st.fixed_dictionaries({}, optional={task: LISTS for task in TASKS}),
    num_envs=st.sampled_from([2, 3, 5]),
    make=st.sampled_from([plain_env, transformed_env]),
)
@settings(max_examples=25, deadline=None)
def test_each_listed_episode_comes_once_and_is_reproducible(episodes, num_envs, make):
    """It does not matter what ran before in the same environment."""
    recorded = run(make(num_envs), wavy, episodes)
    assert recorded.keys() == pairs(episodes)
    for (task, episode), steps in recorded.items():
        assert steps.batch_size == (STEPS,)
        assert (steps == expected_steps(task, episode)).all(), (task, episode)
        assert steps["task_id"].unique().tolist() == [lw.task_id(task)]
        assert steps["episode"].unique().tolist() == [episode]


@pytest.mark.parametrize("make", [plain_env, transformed_env])
def test_episodes_of_different_lengths_keep_their_index(make):
    """A row that ends early starts the next listed episode, not the next one of the row's counter."""
    env, ending = make(3), {("push", 7): 2, ("reach", 4): 5, ("reach", 1): 1}
    names = {(lw.task_id(task), episode): length for (task, episode), length in ending.items()}
    clock: dict[tuple[int, int], int] = {}

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        wavy(tensordict)
        for row in torch.nonzero(tensordict["_step"]).flatten().tolist():
            key = tensordict["task_id"][row].item(), tensordict["episode"][row].item()
            clock[key] = clock.get(key, 0) + 1
            if clock[key] == names.get(key):
                tensordict["action"][row] = float("nan")
        return tensordict

    episodes = {"push": [7, 0, 9, 3], "reach": [4, 1, 11, 2, 6]}
    keys = [*KEYS, ("next", "fault")]
    with pytest.warns(UserWarning, match="its action is NaN"):
        recorded = run(env, policy, episodes, keys=keys)
    assert recorded.keys() == pairs(episodes)
    for key, steps in recorded.items():
        assert steps["next", "fault"].any().item() == (key in ending)
        assert torch.equal(steps["observation"], expected_steps(*key)["observation"][: ending.get(key, STEPS)])


def test_the_policy_reads_the_mask_of_active_rows():
    masks = []

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        assert tensordict.batch_size == (5,)
        masks.append(tensordict["_step"].clone())
        wavy(tensordict)
        tensordict["action"][~tensordict["_step"]] = float("nan")
        return tensordict

    recorded = run(plain_env(5), policy, {"push": [3], "reach": [0, 1, 2]})
    assert recorded.keys() == {("push", 3), ("reach", 0), ("reach", 1), ("reach", 2)}
    assert all((steps == expected_steps(*key)).all() for key, steps in recorded.items())
    assert len(masks) == 2 * STEPS, "three episodes on two rows"
    assert [mask.sum().item() for mask in masks] == [3] * STEPS + [1] * STEPS


def test_an_abandoned_run_does_not_change_the_next_one():
    env = transformed_env(3)
    with torch.no_grad():
        episodes = run_episodes(env, wavy, {"push": [5, 6], "reach": [5, 6, 7]}, keys=KEYS)
        next(episodes)
        episodes.close()
    recorded = run(env, wavy, {"push": [1], "reach": [2]})
    assert all((steps == expected_steps(*key)).all() for key, steps in recorded.items())


@pytest.mark.parametrize("make", [plain_env, transformed_env])
def test_results_do_not_depend_on_the_number_of_rows(network, make):
    """Bit for bit, with a network in blocks, noise, and many steps."""
    episodes = {"push": [0, 4, 2], "reach": [6, 1, 3, 5]}
    keys = [*KEYS, "clean", *(["qaf"] if make is transformed_env else [])]
    options = {"noise": lambda number: (0.3, 0.2, 0.1, 0.05 * number), "clean_action": "clean", "keys": keys}
    runs = [run(make(rows, 60), in_blocks(network), episodes, **options) for rows in (2, 5, 7)]
    assert runs[0].keys() == pairs(episodes)
    for other in runs[1:]:
        assert other.keys() == runs[0].keys()
        assert all((runs[0][key] == other[key]).all() for key in other)
    again = run(make(5, 60), in_blocks(network), {"reach": [5]}, **options)
    assert (again["reach", 5] == runs[0]["reach", 5]).all(), "other episodes must not matter either"


def test_blocks_give_the_policys_results(network):
    torch.manual_seed(1)
    states = TensorDict({"observation": torch.randn(200, 39), "row": torch.arange(200)}, [200])
    whole = in_blocks(network)(states.clone())
    assert (whole.exclude("action") == states).all()
    assert torch.allclose(whole["action"], network(states.clone())["action"], atol=1e-6)
    for size in (1, 2, 63, 64, 65, 128, 130, 199):
        assert (in_blocks(network)(states[:size].clone()) == whole[:size]).all(), size
    order = torch.randperm(200, generator=torch.Generator().manual_seed(0))
    assert torch.equal(in_blocks(network)(states[order].clone())["action"], whole["action"][order])


@pytest.mark.parametrize("hold", [1, 3])
def test_noise_depends_only_on_the_episode(hold):
    episodes = {"push": [2, 7], "reach": [0]}

    def scale(number: int) -> tuple[float, ...]:
        return (0.1 * number, 0.5, 0.0, 2.0)

    keys = [*KEYS, "clean"]
    recorded = run(plain_env(3), wavy, episodes, noise=scale, noise_hold=hold, clean_action="clean", keys=keys)
    clipped = 0
    for (task, episode), steps in recorded.items():
        noise = torch.from_numpy(action_noise(task, SEED, episode, STEPS, hold) * np.float32(scale(episode)))
        expected = (wavy(steps.select("observation"))["action"] + noise).clamp(-1, 1)
        assert torch.equal(steps["clean"], wavy(steps.select("observation"))["action"])
        assert torch.equal(steps["action"], expected)
        assert torch.equal(steps["action"][:, 2], steps["clean"][:, 2])
        assert not torch.equal(steps["action"], steps["clean"])
        clipped += (expected.abs() == 1).sum().item()
    assert clipped > 0
    quiet = run(plain_env(3), wavy, episodes, clean_action="clean", keys=keys)
    assert all(torch.equal(steps["action"], steps["clean"]) for steps in quiet.values())
    assert all((steps.exclude("clean") == expected_steps(*key)).all() for key, steps in quiet.items())


@pytest.mark.parametrize("after", first_fast([0, 7]))
@pytest.mark.parametrize("make", [plain_env, transformed_env])
def test_stopping_after_success_does_not_change_success(make, after):
    length, episodes = 110, {"push": [3, 0, 8], "reach": [5, 2, 0, 7, 1]}
    keys, noise = ["observation", "action", ("next", "success")], lambda _: (0.2,) * 4
    progress: dict[int | None, list[int]] = {None: [], after: []}
    runs = {}
    for stop, counts in progress.items():
        options = {"keys": keys, "noise": noise, "after_success": stop, "on_progress": counts.append}
        runs[stop] = run(make(3, length), lw.ExpertActor(TASKS), episodes, **options)
    assert runs[after].keys() == runs[None].keys() == pairs(episodes)
    for key, whole in runs[None].items():
        assert whole.batch_size == (length,)
        success, short = whole["next", "success"].flatten(), runs[after][key]
        assert len(short) == (min(int(success.nonzero()[0]) + 1 + after, length) if success.any() else length)
        assert (short == whole[: len(short)]).all()
    assert len({len(steps) for steps in runs[after].values()}) > 3, "episodes of different lengths"
    assert sum(progress[after]) == sum(progress[None]) == len(runs[None]) * length
    assert len(progress[after]) < len(progress[None])


def test_a_module_may_ask_for_smaller_blocks():
    sizes = []

    class Counts(torch.nn.Module):
        rows_at_once = 4

        def forward(self, tensordict):
            sizes.append(len(tensordict))
            return tensordict.set("seen", tensordict.get("observation") + 1)

    states = TensorDict(observation=torch.rand(10, 3), batch_size=10)
    result = in_blocks(torch.nn.Sequential(Counts()))(states)
    assert sizes == [4, 4, 4]
    assert result is states
    assert torch.equal(result["seen"], states["observation"] + 1)
