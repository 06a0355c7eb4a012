"""evaluate runs the requested episodes, bit for bit on any number of environments, as Meta-World does; PlanUse."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs.utils import ExplorationType, exploration_type

import lw_torchrl as lw
from lw_torchrl.envs.episodes import FinishedEpisode
from lw_torchrl.envs.rows import action_noise, episode_seed
from lw_torchrl.evaluation import evaluate
from lw_torchrl.evaluation.plan_use import PlanUse, expert_use
from lw_torchrl.suites.metaworld.environments import MetaWorldEngine, make_metaworld_env
from lw_torchrl.suites.metaworld.vectorized_engine import VectorizedEngine

PLANS = lw.load_plans("MT10")
SEED = 1000


def run(actor, tasks, **changed):
    options = dict(episodes_per_task=3, seed=SEED, max_steps=40, record_actions=True, progress=False)
    return evaluate(actor, tasks=tasks, **{**options, **changed})


def make_actor(seed=0, **options):
    torch.manual_seed(seed)
    return lw.PlanConditionedActor(PLANS, **options)


def by_episode(result):
    return {(e.task, e.episode): e for e in result.episodes}


def assert_same(result, expected):
    """Assert that two results, or parts of them, have the same episodes, with actions that are equal bit for bit."""
    episodes, expected = (each if isinstance(each, dict) else by_episode(each) for each in (result, expected))
    assert episodes == expected
    for key in expected:
        assert torch.equal(episodes[key].actions, expected[key].actions), key


@pytest.mark.parametrize("num_envs", [None, 5])
def test_exactly_k_episodes_of_each_task(num_envs):
    result = run(lw.ExpertActor(["push", "reach"]), ["reach", "push"], num_envs=num_envs, max_steps=4)
    assert [(e.task, e.episode) for e in result.episodes] == list(itertools.product(["push", "reach"], range(3)))
    assert all(e.actions.shape == (4, 4) and e.actions.dtype == torch.float32 for e in result.episodes)
    assert (result.config["tasks"], result.config["seed"]) == (["push", "reach"], SEED)
    other = run(lw.ExpertActor("push"), "push", max_steps=4, seed=SEED + 1, noise_scale=0.0).episodes[0]
    same = run(lw.ExpertActor("push"), "push", max_steps=4, noise_scale=0.0).episodes[0]
    assert not torch.equal(other.actions, same.actions)
    assert run(lw.ExpertActor("push"), "push", max_steps=2, record_actions=False).episodes[0].actions is None


@pytest.fixture(scope="module")
def alone():
    """An evaluation of two tasks in two environments."""
    return run(make_actor(), ["drawer-open", "push"], num_envs=2)


@pytest.mark.parametrize(
    "changed",
    [
        dict(num_envs=None),
        dict(num_envs=5),
        dict(num_envs=66),  # more than one block of rows
        dict(tasks=["drawer-open", "push", "reach", "window-open"], num_envs=9),
        dict(episodes_per_task=5),
        dict(engine=MetaWorldEngine, num_threads=2),
    ],
    ids=str,
)
def test_an_episode_does_not_depend_on_rows_other_tasks_other_episodes_or_the_engine(alone, changed):
    other = by_episode(run(make_actor(), **{"tasks": ["drawer-open", "push"], **changed}))
    assert_same({key: other[key] for key in by_episode(alone)}, by_episode(alone))


def test_a_plain_function_runs_as_a_module_does():
    actor = lw.modules.DescriptorConditionedActor("MT10").eval()
    expected = run(actor, "reach", num_envs=1, max_steps=15)
    assert_same(run(lambda state: actor(state), "reach", num_envs=3, max_steps=15), expected)
    assert_same(run(actor, "reach", num_envs=3, max_steps=15), expected)


def test_the_noise_depends_on_the_episode_and_is_clipped():
    def still(state):
        return state.set("action", torch.full((*state.batch_size, 4), 0.9))

    for scale in (0.2, 0.0):
        for e in run(still, "reach", noise_scale=scale, num_envs=2).episodes:
            noise = action_noise("reach", SEED, e.episode, 40) * np.float32(scale)
            assert torch.equal(e.actions, (0.9 + torch.from_numpy(noise)).clamp(-1, 1))


def assert_equal_in_metaworld(result):
    """Run the recorded actions in Meta-World's own environments and compare the success at each step."""
    envs = {task: make_metaworld_env(task) for task in result.config["tasks"]}
    for e in result.episodes:
        (env := envs[e.task]).seed(episode_seed(e.task, SEED, e.episode))
        env.reset()
        success = [bool(env.step(action.numpy())[4]["success"]) for action in e.actions]
        assert any(success) == e.success, (e.task, e.episode)
        assert (success.index(True) + 1 if any(success) else None) == e.first_success
        if e.success_at_end is not None:
            assert (success[-1], sum(success)) == (e.success_at_end, e.episode_return)


@pytest.fixture(scope="module")
def trained():
    """The shipped policy, which reaches in 75 steps, but does not open drawers."""
    return lw.load_actor("few-shot-mt50")


@pytest.fixture(scope="module")
def whole(trained):
    """The trained policy's evaluation, with whole episodes."""
    return run(trained, ["drawer-open", "reach"], episodes_per_task=4, max_steps=75, num_envs=6)


@pytest.mark.slow
def test_a_trained_policys_actions_succeed_equally_in_metaworlds_own_environments(whole):
    assert whole.mean_success > 0, "the test needs successes"
    assert_equal_in_metaworld(whole)


@pytest.mark.slow
def test_the_experts_actions_succeed_equally_in_metaworlds_own_environments():
    result = run(lw.ExpertActor("MT10"), "MT10", episodes_per_task=2, max_steps=500, num_envs=13)
    assert [e.success for e in result.episodes].count(True) >= 15
    assert {e.success_at_end for e in result.episodes} == {True, False}
    assert_equal_in_metaworld(result)


@pytest.mark.parametrize("num_envs", [None, pytest.param(3, marks=pytest.mark.slow)])
def test_stopping_at_success_does_not_change_the_success_rate(trained, whole, num_envs):
    options = dict(episodes_per_task=4, max_steps=75, stop_at_success=True, num_envs=num_envs)
    stopped = run(trained, ["drawer-open", "reach"], **options)
    for e, other in zip(stopped.episodes, whole.episodes, strict=True):
        unknown = {"success_at_end": None, "episode_return": None}
        assert e == replace(other, **unknown)
        assert torch.equal(e.actions, other.actions[: e.first_success or 75])
    assert {e.success for e in whole.episodes} == {True, False}
    if num_envs is not None:
        assert_equal_in_metaworld(stopped)


def test_the_return_is_the_sum_of_dense_rewards():
    sparse = run(lw.ExpertActor("reach"), "reach", max_steps=60)
    dense = run(lw.ExpertActor("reach"), "reach", max_steps=60, reward="dense")
    assert all(a.episode_return > b.episode_return for a, b in zip(dense.episodes, sparse.episodes, strict=True))
    env = make_metaworld_env("reach", max_steps=60)
    env.seed(episode_seed("reach", SEED, 0))
    env.reset()
    total = sum(np.float32(env.step(action.numpy())[1]) for action in dense.episodes[0].actions)
    assert dense.episodes[0].episode_return == pytest.approx(total, rel=1e-5)


class Recorder(nn.Module):
    """A policy that records the mode in which it is called."""

    def __init__(self, value=0.1):
        super().__init__()
        self.calls, self.value = [], value

    def forward(self, observation):
        self.calls.append((self.training, torch.is_grad_enabled(), exploration_type(), tuple(observation.shape)))
        return torch.full((len(observation), 4), self.value)


@pytest.mark.parametrize("training", [True, False])
def test_the_actor_runs_in_eval_mode_and_its_mode_is_restored(training):
    actor = TensorDictModule(Recorder(), in_keys=["observation"], out_keys=["action"]).train(training)
    run(actor, "reach", max_steps=3)
    assert actor.training is actor.module.training is training
    assert {call[:3] for call in actor.module.calls} == {(False, False, ExplorationType.DETERMINISTIC)}
    assert len({call[3] for call in actor.module.calls}) == 1, "every forward pass has the same number of rows"


def test_a_nan_action_is_an_error_that_restores_the_mode():
    actor = TensorDictModule(Recorder(torch.nan), in_keys=["observation"], out_keys=["action"]).train()
    with pytest.raises(ValueError, match=r"NaN.*'reach', seed 1000, episode 0, step 0"):
        run(actor, "reach")
    assert actor.training


def test_an_unstable_simulation_is_a_failed_episode(monkeypatch):
    step, steps = VectorizedEngine.step, itertools.count(1)

    def unstable(self, *arguments):
        result = step(self, *arguments)
        result.fault[1] |= next(steps) == 4
        return result

    monkeypatch.setattr(VectorizedEngine, "step", unstable)
    expert = lw.ExpertActor("reach")
    with pytest.warns(UserWarning, match="unstable, in task 'reach', seed 1000, episode 1"):
        result = evaluate(expert, tasks="reach", episodes_per_task=3, seed=1000, num_envs=3, progress=False)
    assert [episode.success for episode in result.episodes] == [True, False, True]


def test_an_actor_is_evaluated_on_its_own_plans():
    actor = make_actor(text_encoder=lambda texts: torch.eye(len(texts), 40))
    pairs = [("the gripper is open", "move the gripper to the reach target")]
    other_plans = lw.Plans([lw.ConditionalPlan.from_pairs("reach", pairs)])
    with pytest.raises(ValueError, match=r"plans differ from the actor's plans for reach; .*with_plans"):
        run(actor, "reach", plans=other_plans)
    other, own = (run(each, "reach", max_steps=8) for each in (actor.with_plans(other_plans), actor))
    assert not torch.equal(other.episodes[0].actions, own.episodes[0].actions)


def test_an_actor_without_plans_receives_the_answers_for_given_plans():
    seen = []

    def policy(state):
        seen.append(state["qaf"].clone())
        return state.set("action", torch.zeros(*state.batch_size, 4))

    run(policy, "reach", plans=PLANS, max_steps=2)
    assert (seen[0].dtype, seen[0].shape[-1]) == (torch.bool, PLANS.num_steps)


def test_the_actors_tasks_or_else_its_plans_are_the_default():
    assert set(run(lw.ExpertActor(["push", "reach"]), None).success_once) == {"push", "reach"}
    assert set(run(make_actor(), None, episodes_per_task=1).success_once) == set(PLANS)
    with pytest.raises(ValueError, match="tasks is required"):
        run(lambda state: state, None)


def test_keys_of_the_environment_and_of_the_actor_are_recorded():
    episodes = []
    keys = ["qaf", "skill_weights", ("next", "qaf"), ("next", "done"), ("next", "observation")]
    run(make_actor(), "reach", also_record=keys, max_steps=3, episodes_per_task=1, on_episode=episodes.append)
    (finished,) = episodes
    assert (finished.task, finished.episode, finished.steps.batch_size) == ("reach", 0, (3,))
    assert all(key in finished.steps.keys(True) for key in keys)


REACH = {"reach": lw.load_plans("MT10")["reach"]}  # three steps


def episode(number, steps, success_at=None, weights=True):
    """An episode in which at step t only condition ``steps[t]`` holds, none for -1, and its skill is chosen."""
    chosen = torch.tensor(steps)
    qaf = torch.nn.functional.one_hot(chosen.clamp(min=0), 4).bool() & (chosen >= 0)[:, None]
    success = torch.zeros(len(steps), 1, dtype=torch.bool)
    if success_at is not None:
        success[success_at] = True
    rows = TensorDict({"qaf": qaf, "next": TensorDict({"success": success}, [len(steps)])}, [len(steps)])
    if weights:
        rows["skill_weights"] = torch.nn.functional.one_hot(chosen.clamp(min=0), 4).float()
    return FinishedEpisode("reach", number, rows)


def test_states_count_until_20_steps_after_the_first_success():
    use = PlanUse(REACH)
    use(episode(0, [0] * 10 + [1] * 5 + [2] * 100, success_at=14))
    reach = use.tasks()["reach"]
    assert (reach.states, reach.true, reach.chosen) == (35, pytest.approx([10 / 35, 5 / 35, 20 / 35]), reach.true)
    assert (reach.covered, reach.num_true, reach.failed, reach.stuck) == (1.0, 1.0, 0, [0, 0, 0])


def test_gaps_and_stuck_steps_of_failures_are_counted():
    use = PlanUse(REACH)
    use(episode(0, [0] * 30 + [1] * 60 + [-1] * 10))
    use(episode(1, [2] * 200))
    use(episode(2, [-1] * 3 + [0] * 4 + [-1] + [0] * 12 + [-1] * 30, success_at=29))
    reach = use.tasks()["reach"]
    assert (reach.failed, reach.stuck, reach.gaps) == (2, [0, 1, 1], [(0, 90, 99), (2, 0, 2), (2, 7, 7), (2, 20, 29)])
    assert abs(reach.covered - 306 / 330) < 1e-6


def test_true_conditions_count_where_no_step_is_chosen():
    use = PlanUse(REACH)
    use(episode(0, [0, 1, 1], weights=False))
    reach = use.tasks()["reach"]
    assert (reach.chosen, reach.stuck, reach.to_json()["states"]) == ([], [0, 1, 0], 3)


def test_experts_stop_after_the_states_that_count():
    tasks, plans = ["drawer-open", "reach"], lw.load_plans("MT10")
    whole, options = PlanUse(plans), {"seed": 4, "max_steps": 250, "noise_scale": 0.0, "also_record": ["qaf"]}
    lw.evaluate(lw.ExpertActor(tasks), tasks=tasks, plans=plans, episodes_per_task=2, on_episode=whole, **options)
    assert expert_use(plans, tasks, episodes_per_task=2, seed=4) == whole.tasks()
