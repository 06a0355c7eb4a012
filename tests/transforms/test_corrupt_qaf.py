"""CorruptQAF: answers that are wrong on purpose, the same ones wherever and beside whatever an episode is run."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from random_states import CONDITIONS, PLANS, RandomStates
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.data import Bounded, Composite, LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, EnvBase, SerialEnv, TransformedEnv, check_env_specs
from torchrl.envs.transforms import ModuleTransform

import lw_torchrl as lw
from lw_torchrl._util.reproducibility import episode_generator

ROWS = 4
OPEN = CONDITIONS[0]


def both(env: EnvBase, **options) -> TransformedEnv:
    """The environment with the exact answers beside the spoilt ones."""
    exact, told = lw.QAFTransform(PLANS, out_keys=["exact"]), lw.QAFTransform(PLANS)
    return TransformedEnv(env, Compose(exact, told, lw.CorruptQAF(PLANS, **options)))


def draws(purpose: str, task: str, seed: int, episode: int, step: int, width: int) -> Tensor:
    """Numbers for a plan's answers in one step: the (step % 64)-th line of the block that the step is in."""
    drawn = episode_generator(f"answers/{purpose}/{step // 64}", task, seed, episode).random((64, width))
    return torch.from_numpy(drawn[step % 64])


def expected(exact, task, episode, flip=0.0, every=1, delay=0, seed=0) -> Tensor:
    """What is shown in the last step of an episode with these exact answers, one after the other in plain Python."""
    steps, step = PLANS[task].steps, len(exact) - 1
    shown = exact[every * (max(step - delay, 0) // every)][: len(steps)]
    shown = shown ^ (draws("flip", task, seed, episode, step, len(steps)) < flip)
    return torch.nn.functional.pad(shown, (0, PLANS.num_steps - len(steps)))


SPOILT = [
    {"flip": 0.3},
    {"delay": 3},
    {"every": 3, "delay": 2},
    {"flip": 0.1, "every": 2, "delay": 3, "seed": 11},
]
masks = st.lists(st.booleans(), min_size=ROWS, max_size=ROWS).map(torch.tensor)
moves = st.lists(st.tuples(st.sampled_from(["step", "step", "step", "reset"]), masks), max_size=20)


@settings(max_examples=30, deadline=None)
@given(st.sampled_from(SPOILT), moves)
def test_it_is_what_a_plain_program_gives_over_any_resets(options, done):
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
            wanted = expected(episodes[row], ("push", "reach")[row % 2], int(state["episode"][row]), **options)
            assert torch.equal(state["qaf"][row], wanted), (row, kind)


@pytest.mark.parametrize("options", SPOILT)
def test_soft_answers_of_a_module_become_late_held_and_wrong_alike(options):
    """As those of a learned evaluator that runs in the environment, before it."""

    class Evaluate(ModuleTransform):
        def _reset(self, tensordict, tensordict_reset):
            return self._call(tensordict_reset)

    def to_float(spec: Composite) -> Composite:
        spec["qaf"] = Bounded(0.0, 1.0, spec["qaf"].shape)
        return spec

    module = TensorDictModule(lambda qaf: 0.25 + 0.5 * qaf.float(), in_keys=["qaf"], out_keys=["qaf"])
    soft = Evaluate(module=module, observation_spec_transform=to_float)
    parts = lw.QAFTransform(PLANS), soft, lw.CorruptQAF(PLANS, **options)
    env = TransformedEnv(RandomStates(ROWS), Compose(*parts))
    check_env_specs(env)
    env, plain = (
        TransformedEnv(RandomStates(ROWS), Compose(*(part.clone() for part in parts))),
        both(RandomStates(ROWS), **options),
    )
    found, expected = env.rollout(12)["qaf"], plain.rollout(12)["qaf"]
    assert found.dtype == torch.float32
    assert set(found.unique().tolist()) == {0.25, 0.75}
    assert torch.equal(found > 0.5, expected)


def test_how_often_it_flips():
    found = both(RandomStates(6), flip=0.2, seed=5).rollout(200)
    real = torch.zeros(6, 200, 4, dtype=torch.bool)
    real[0::2, :, :2], real[1::2] = True, True
    wrong = found["qaf"] ^ found["exact"]
    assert wrong[real].float().mean() == pytest.approx(0.2, abs=0.02)
    assert not wrong[~real].any(), "padding is false"
    assert not (wrong[:, 1:] & wrong[:, :-1])[real[:, 1:]].float().mean() > 0.06, "each step is drawn for itself"
    always = both(RandomStates(2), flip=1.0).rollout(5)
    assert torch.equal(always["qaf"][1], ~always["exact"][1])


def test_a_greater_probability_spoils_what_a_smaller_one_spoils():
    few, many = (both(RandomStates(2), flip=p).rollout(50) for p in (0.1, 0.3))
    few, many = (found["qaf"] ^ found["exact"] for found in (few, many))
    assert 0 < few.sum() < many.sum()
    assert not (few & ~many).any()


def test_another_seed_is_other_errors():
    first, again, other = (both(RandomStates(2), flip=0.3, seed=seed).rollout(30)["qaf"] for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_beyond_a_block_of_draws_and_into_the_next_episode():
    found = both(RandomStates(2, length=70), flip=0.3, delay=1).rollout(75, break_when_any_done=False)
    row = found[0]
    assert row["episode"][[0, -1]].tolist() == [0, 1]
    for step in (0, 63, 64, 69):
        wanted = expected(list(row["exact"][: step + 1]), "push", 0, flip=0.3, delay=1)
        assert torch.equal(row["qaf"][step], wanted)
    assert torch.equal(row["qaf"][72], expected(list(row["exact"][70:73]), "push", 1, flip=0.3, delay=1))


# --- wherever it is run --------------------------------------------------------------------------------------------


def episodes_of(rollout: TensorDictBase) -> dict[tuple[int, int], list[list[bool]]]:
    """(task id, episode) to its answers, of (..., T)."""
    found: dict[tuple[int, int], list[list[bool]]] = {}
    for row in rollout.reshape(-1, rollout.shape[-1]):
        for step in row:
            found.setdefault((int(step["task_id"]), int(step["episode"])), []).append(step["qaf"].tolist())
    return found


def walk(env: EnvBase, steps: int) -> TensorDictBase:
    shape = env.batch_size
    return env.rollout(steps, lambda td: td.set("action", torch.full((*shape, 4), 0.5)), break_when_any_done=False)


def test_the_number_of_environments_and_workers_changes_nothing():
    tasks, options = ["push", "reach"], {"flip": 0.2, "delay": 1}

    def make(rows: int, names=tasks, worker=None) -> EnvBase:
        return lw.LanguageWorldEnv(names, num_envs=rows, seed=1, max_steps=6, num_threads=1, worker=worker)

    def spoilt(env: EnvBase) -> TransformedEnv:
        return TransformedEnv(env, Compose(lw.QAFTransform(PLANS), lw.CorruptQAF(PLANS, **options)))

    envs = [
        spoilt(make(2)),
        spoilt(make(4)),
        spoilt(SerialEnv(2, [partial(make, 2, worker=(w, 2)) for w in range(2)])),
        SerialEnv(2, [lambda w=w: spoilt(make(2, worker=(w, 2))) for w in range(2)]),
        spoilt(make(1, ["reach"])),
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
    if place == "inside":
        env = SerialEnv(
            2, [lambda: both(RandomStates(2, 5), **options), lambda: both(RandomStates(2, 7, 2), **options)]
        )
    else:
        env = both(SerialEnv(2, [lambda: RandomStates(2, 5), lambda: RandomStates(2, 7, 2)]), **options)
    found = env.rollout(25, break_when_any_done=False)
    for row in found.reshape(-1, 25):
        task = "push" if row["task_id"][0] == lw.task_id("push") else "reach"
        for number in range(int(row["episode"].max()) + 1):
            one = row[row["episode"] == number]
            for step in range(len(one)):
                wanted = expected(list(one["exact"][: step + 1]), task, number, **options)
                assert torch.equal(one["qaf"][step], wanted)
    env.close()


def test_a_collector():
    env = both(RandomStates(ROWS, 7), flip=0.3)
    frames = {"frames_per_batch": ROWS * 10, "total_frames": ROWS * 20}
    collector = Collector(env, None, **frames, auto_register_policy_transforms=False)
    found = torch.cat([batch.clone() for batch in collector], -1)
    collector.shutdown()
    straight = both(RandomStates(ROWS, 7), flip=0.3).rollout(20, break_when_any_done=False)
    assert torch.equal(found["qaf"], straight["qaf"])


def test_an_environment_that_is_resumed_goes_on_with_the_same_errors():
    def make() -> TransformedEnv:
        return both(lw.LanguageWorldEnv(["push", "reach"], seed=3, max_steps=9), flip=0.3, delay=1)

    whole, first, second = make(), make(), make()
    walk(first, 5)
    second.load_state_dict(first.state_dict())
    walk(whole, 5)
    expect, found = walk(whole, 12), walk(second, 12)
    assert torch.equal(found["qaf"], expect["qaf"])
    assert not torch.equal(found["qaf"], found["exact"])
    for env in (whole, first, second):
        env.close()


def test_errors_under_way_do_not_outlive_a_loaded_state():
    """Also over an environment that does not ask for a reset itself."""
    env = TransformedEnv(RandomStates(2), Compose(lw.QAFTransform(PLANS), lw.CorruptQAF(PLANS, delay=1)))
    state = env.reset()
    env.load_state_dict(env.state_dict())
    with pytest.raises(RuntimeError, match=r"not since load_state_dict.*reset the environment"):
        env.step(state.set("action", torch.zeros(2, 4)))


@pytest.mark.parametrize("kind", ["scripted", "pcbc"])
def test_an_evaluation_hangs_neither_on_num_envs_nor_on_the_tasks_beside(kind):
    plans = lw.load_plans("MT10")
    actor = lw.ScriptedSkillActor(plans) if kind == "scripted" else lw.PlanConditionedActor(plans)
    spoilt = lw.CorruptQAF(plans, flip=0.2, delay=1)

    def answers(**options) -> dict[tuple[str, int], Tensor]:
        seen = []
        lw.evaluate(
            actor, episodes_per_task=2, seed=7, max_steps=25, also_record=["qaf"], on_episode=seen.append, **options,
        )  # fmt: skip
        return {(one.task, one.episode): one.steps.select("qaf", "action") for one in seen}

    few = answers(tasks=["drawer-open", "reach"], evaluator=spoilt, num_envs=2)
    many = answers(tasks=["drawer-open", "push", "reach"], evaluator=spoilt, num_envs=6)
    exact = answers(tasks=["drawer-open", "reach"])
    for which, found in few.items():
        assert (found == many[which]).all(), which
        assert not torch.equal(found["qaf"], exact[which]["qaf"])


def test_other_plans_are_spoilt_alike():
    spoilt = lw.CorruptQAF(PLANS, flip=0.1, delay=2, seed=4)
    other = spoilt.with_plans(lw.Plans([PLANS["reach"]]))
    assert (other.flip, other.delay, other.seed) == (0.1, 2, 4)


# --- bad input -----------------------------------------------------------------------------------------------------


def test_without_answers_it_says_who_writes_them():
    env = TransformedEnv(RandomStates(2), lw.CorruptQAF(PLANS))
    with pytest.raises(ValueError, match=r"without qaf: QAFTransform\(plans\) in the environment"):
        env.reset()
    with pytest.raises(ValueError, match=r"without qaf: QAFTransform\(plans\) in the environment"):
        _ = env.observation_spec
    before = TransformedEnv(RandomStates(2), Compose(lw.CorruptQAF(PLANS), lw.QAFTransform(PLANS)))
    with pytest.raises(ValueError, match="without qaf"):
        before.reset()


def test_answers_of_other_plans_are_refused():
    turned = lw.Plans([lw.ConditionalPlan("reach", PLANS["reach"].steps[::-1]), PLANS["push"]])
    env = TransformedEnv(RandomStates(2), Compose(lw.QAFTransform(turned), lw.CorruptQAF(PLANS)))
    with pytest.raises(ValueError, match="qaf answers other plans"):
        env.reset()
    narrow = TransformedEnv(RandomStates(1), Compose(lw.QAFTransform(PLANS), lw.CorruptQAF({"push": PLANS["push"]})))
    with pytest.raises(ValueError, match=r"qaf must be bool, .* of shape \(1, 2\), got .* of shape \(1, 4\)"):
        narrow.reset()


def test_a_replay_buffer_is_refused():
    rows = TransformedEnv(RandomStates(2), lw.QAFTransform(PLANS)).rollout(3).flatten()
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(6), transform=lw.CorruptQAF(PLANS), batch_size=6)
    replay.extend(rows)
    with pytest.raises(ValueError, match="rows of a replay buffer do not record: put it into the environment"):
        replay.sample()


def test_a_failure_for_want_of_answers_is_the_querys_also_beside_other_plans():
    plans = lw.Plans({"button-press-topdown": lw.load_plans("MT50")["button-press-topdown"]})
    steps = plans["button-press-topdown"].steps
    reference = lw.Plans([lw.ConditionalPlan("button-press-topdown", steps[:1])])
    result = lw.evaluate(
        lw.ScriptedSkillActor(plans),
        tasks="button-press-topdown",
        episodes_per_task=1,
        seed=7,
        max_steps=150,
        evaluator=lw.CorruptQAF(plans, flip=1.0),
        attribute=True,
        reference=reference,
    )
    [failure] = result.failures
    assert failure.cause == "query"
    assert failure.counterfactuals == {"query": True}, "what was wrong and is put right mends it: no need to try more"
