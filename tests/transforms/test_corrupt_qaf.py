"""CorruptQAF: late and wrong answers, which do not depend on other rows, workers or resumption."""

from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from random_states import PLANS, RandomStates
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import Bounded, Composite
from torchrl.envs import Compose, EnvBase, SerialEnv, TransformedEnv, check_env_specs
from torchrl.envs.transforms import ModuleTransform

import lw_torchrl as lw
from lw_torchrl._util.reproducibility import episode_hash

ROWS = 4


def both(env: EnvBase, **options) -> TransformedEnv:
    """Return the environment with exact answers and corrupted ones."""
    exact, corrupted = lw.QAFTransform(PLANS, out_keys=["exact"]), lw.QAFTransform(PLANS)
    return TransformedEnv(env, Compose(exact, corrupted, lw.transforms.CorruptQAF(PLANS, **options)))


def draws(task: str, seed: int, episode: int, step: int, width: int) -> Tensor:
    """Return the random numbers for a plan's answers in one step, by SplitMix64 in Python's integers."""
    numbers = []
    for column in range(1, width + 1):
        bits = episode_hash("answers/flip", task, seed, episode) + (step * 2**32 + column) * 0x9E3779B97F4A7C15
        bits = bits % 2**64
        bits = (bits ^ bits >> 30) * 0xBF58476D1CE4E5B9 % 2**64
        bits = (bits ^ bits >> 27) * 0x94D049BB133111EB % 2**64
        numbers.append(((bits ^ bits >> 31) >> 11) / 2**53)
    return torch.tensor(numbers, dtype=torch.float64)


def expected(exact, task, episode, flip=0.0, every=1, delay=0, seed=0) -> Tensor:
    """Return the answers shown in the last step of an episode with these exact answers, in plain Python."""
    steps, step = PLANS[task].steps, len(exact) - 1
    shown = exact[every * (max(step - delay, 0) // every)][: len(steps)]
    shown = shown ^ (draws(task, seed, episode, step, len(steps)) < flip)
    return torch.nn.functional.pad(shown, (0, PLANS.num_steps - len(steps)))


CORRUPTIONS = [{"flip": 0.3}, {"delay": 3}, {"every": 3, "delay": 2}, {"flip": 0.1, "every": 2, "delay": 3, "seed": 11}]
masks = st.lists(st.booleans(), min_size=ROWS, max_size=ROWS).map(torch.tensor)
moves = st.lists(st.tuples(st.sampled_from(["step", "step", "step", "reset"]), masks), max_size=20)


@settings(max_examples=30, deadline=None)
@given(st.sampled_from(CORRUPTIONS), moves)
def test_answers_equal_a_plain_program_over_any_resets(options, done):
    env = both(RandomStates(ROWS), **options)
    state = env.reset()
    episodes = [[one] for one in state["exact"]]
    for kind, mask in [("", torch.zeros(ROWS, dtype=torch.bool)), *done]:
        if kind == "reset" and mask.any():
            state = env.reset(state.set("_reset", mask))
        elif kind == "step":
            state = env.step(state.set("action", torch.zeros(ROWS, 4)).set("_step", mask))["next"]
        for row in mask.nonzero().flatten().tolist():
            episodes[row] = [*([] if kind == "reset" else episodes[row]), state["exact"][row]]
        for row in range(ROWS):
            shown_answers = expected(episodes[row], ("push", "reach")[row % 2], int(state["episode"][row]), **options)
            assert torch.equal(state["qaf"][row], shown_answers), (row, kind)


@pytest.mark.parametrize("options", CORRUPTIONS)
def test_soft_answers_are_corrupted_alike(options):
    class Evaluate(ModuleTransform):
        def _reset(self, tensordict, tensordict_reset):
            return self._call(tensordict_reset)

    def to_float(spec: Composite) -> Composite:
        spec["qaf"] = Bounded(0.0, 1.0, spec["qaf"].shape)
        return spec

    module = TensorDictModule(lambda qaf: 0.25 + 0.5 * qaf.float(), in_keys=["qaf"], out_keys=["qaf"])
    soft = Evaluate(module=module, observation_spec_transform=to_float)
    parts = lw.QAFTransform(PLANS), soft, lw.transforms.CorruptQAF(PLANS, **options)
    env = TransformedEnv(RandomStates(ROWS), Compose(*parts))
    check_env_specs(env)
    env.set_seed(0)
    actual, expected = (each.rollout(12)["qaf"] for each in (env, both(RandomStates(ROWS), **options)))
    assert actual.dtype == torch.float32
    assert set(actual.unique().tolist()) == {0.25, 0.75}
    assert torch.equal(actual > 0.5, expected)


def test_flip_rate():
    actual = both(RandomStates(6), flip=0.2, seed=5).rollout(200)
    real = torch.zeros(6, 200, 4, dtype=torch.bool)
    real[0::2, :, :2], real[1::2] = True, True
    wrong = actual["qaf"] ^ actual["exact"]
    assert wrong[real].float().mean() == pytest.approx(0.2, abs=0.02)
    assert not wrong[~real].any(), "padding is false"
    assert not (wrong[:, 1:] & wrong[:, :-1])[real[:, 1:]].float().mean() > 0.06, "each step is drawn for itself"
    always = both(RandomStates(6), flip=1.0).rollout(5)
    assert torch.equal(always["qaf"][1], ~always["exact"][1])
    fewer = both(RandomStates(6), flip=0.1, seed=5).rollout(200)
    fewer = fewer["qaf"] ^ fewer["exact"]
    assert 0 < fewer.sum() < wrong.sum()
    assert not (fewer & ~wrong).any(), "a larger probability flips all that a smaller one flips"


# --- wherever it is run --------------------------------------------------------------------------------------------


def episodes_of(rollout: TensorDictBase) -> dict[tuple[int, int], list[list[bool]]]:
    """Return the answers of each (task id, episode) in a rollout (..., T)."""
    actual: dict[tuple[int, int], list[list[bool]]] = {}
    for row in rollout.reshape(-1, rollout.shape[-1]):
        for step in row:
            actual.setdefault((int(step["task_id"]), int(step["episode"])), []).append(step["qaf"].tolist())
    return actual


def walk(env: EnvBase, steps: int) -> TensorDictBase:
    shape = env.batch_size
    return env.rollout(steps, lambda td: td.set("action", torch.full((*shape, 4), 0.5)), break_when_any_done=False)


def test_errors_do_not_depend_on_the_number_of_environments_and_workers():
    tasks, options = ["push", "reach"], {"flip": 0.2, "delay": 1}

    def make(rows: int, names=tasks, worker=None) -> EnvBase:
        return lw.LanguageWorldEnv(names, num_envs=rows, seed=1, max_steps=6, num_threads=1, worker=worker)

    def corrupted(env: EnvBase) -> TransformedEnv:
        return TransformedEnv(env, Compose(lw.QAFTransform(PLANS), lw.transforms.CorruptQAF(PLANS, **options)))

    envs = [
        corrupted(make(2)),
        corrupted(make(4)),
        corrupted(SerialEnv(2, [partial(make, 2, worker=(w, 2)) for w in range(2)])),
        SerialEnv(2, [lambda w=w: corrupted(make(2, worker=(w, 2))) for w in range(2)]),
        corrupted(make(1, ["reach"])),
    ]
    first, *others = (episodes_of(walk(env, 24)) for env in envs)
    assert len(first) == 8
    for other in others:
        assert len(shared := set(first) & set(other)) >= 4
        assert all(first[which] == other[which] for which in shared)
    for env in envs:
        env.close()


@pytest.mark.parametrize("place", ["inside", "outside"])
def test_rows_of_a_worker_that_end_at_different_steps(place):
    options = {"flip": 0.3, "delay": 2}
    workers = [partial(RandomStates, 2, 5), partial(RandomStates, 2, 7, 2)]
    if place == "inside":
        env = SerialEnv(2, [lambda make=make: both(make(), **options) for make in workers])
    else:
        env = both(SerialEnv(2, workers), **options)
    actual = env.rollout(25, break_when_any_done=False)
    for row in actual.reshape(-1, 25):
        task = lw.MT50[row["task_id"][0]]
        for number in range(int(row["episode"].max()) + 1):
            one = row[row["episode"] == number]
            for step in range(len(one)):
                shown_answers = expected(list(one["exact"][: step + 1]), task, number, **options)
                assert torch.equal(one["qaf"][step], shown_answers)
    env.close()


def test_resumed_environment_continues_with_the_same_errors():
    def make() -> TransformedEnv:
        return both(lw.LanguageWorldEnv(["push", "reach"], seed=3, max_steps=9), flip=0.3, delay=1)

    whole, first, second = make(), make(), make()
    walk(first, 5)
    second.load_state_dict(first.state_dict())
    walk(whole, 5)
    expect, actual = walk(whole, 12), walk(second, 12)
    assert torch.equal(actual["qaf"], expect["qaf"])
    assert not torch.equal(actual["qaf"], actual["exact"])
    for env in (whole, first, second):
        env.close()
    env = both(RandomStates(2), delay=1)  # an environment that does not require a reset itself
    state = env.reset()
    env.load_state_dict(env.state_dict())
    with pytest.raises(RuntimeError, match="reset the environment"):
        env.step(state.set("action", torch.zeros(2, 4)))


def test_evaluation_does_not_depend_on_num_envs_or_other_tasks():
    plans = lw.load_plans("MT10")
    actor = lw.PlanConditionedActor(plans)
    corrupted = lw.transforms.CorruptQAF(plans, flip=0.2, delay=1)

    def answers(**options) -> dict[tuple[str, int], Tensor]:
        seen, settings = [], {"episodes_per_task": 2, "seed": 7, "max_steps": 25, "also_record": ["qaf"]}
        lw.evaluate(actor, on_episode=seen.append, **settings, **options)
        return {(one.task, one.episode): one.steps.select("qaf", "action") for one in seen}

    few = answers(tasks=["drawer-open", "reach"], evaluator=corrupted, num_envs=2)
    many = answers(tasks=["drawer-open", "push", "reach"], evaluator=corrupted, num_envs=6)
    exact = answers(tasks=["drawer-open", "reach"])
    for which, actual in few.items():
        assert (actual == many[which]).all(), which
        assert not torch.equal(actual["qaf"], exact[which]["qaf"])
