"""PlanUse: the shares it reports, from episodes made up by hand."""

import torch
from tensordict import TensorDict

import lw_torchrl as lw
from lw_torchrl.envs.episodes import FinishedEpisode
from lw_torchrl.evaluation.plan_use import PlanUse, expert_use, where_stuck

PLANS = {"reach": lw.load_plans("MT10")["reach"]}  # three steps


def episode(number, steps, success_at=None, weights=True):
    """An episode whose step t has only condition ``steps[t]`` true, none for -1, and takes that step's skill."""
    chosen = torch.tensor(steps)
    qaf = torch.nn.functional.one_hot(chosen.clamp(min=0), 4).bool() & (chosen >= 0)[:, None]
    success = torch.zeros(len(steps), 1, dtype=torch.bool)
    if success_at is not None:
        success[success_at] = True
    found = TensorDict({"qaf": qaf, "next": TensorDict({"success": success}, [len(steps)])}, [len(steps)])
    if weights:
        found["skill_weights"] = torch.nn.functional.one_hot(chosen.clamp(min=0), 4).float()
    return FinishedEpisode("reach", number, found)


def test_shares_of_states_to_twenty_steps_after_the_first_success():
    use = PlanUse(PLANS)
    use(episode(0, [0] * 10 + [1] * 5 + [2] * 100, success_at=14))
    found = use.tasks()["reach"]
    assert found.states == 35
    assert found.true == [10 / 35, 5 / 35, 20 / 35] or torch.allclose(
        torch.tensor(found.true), torch.tensor([10, 5, 20]) / 35
    )
    assert found.chosen == found.true
    assert (found.covered, found.num_true, found.failed, found.stuck) == (1.0, 1.0, 0, [0, 0, 0])


def test_uncovered_states_and_where_failures_end():
    use = PlanUse(PLANS)
    use(episode(0, [0] * 30 + [1] * 60 + [-1] * 10))
    use(episode(1, [2] * 200))
    use(episode(2, [-1] * 3 + [0] * 4 + [-1] + [0] * 12 + [-1] * 30, success_at=29))
    found = use.tasks()["reach"]
    assert found.failed == 2
    assert found.stuck == [0, 1, 1]
    assert found.gaps == [(0, 90, 99), (2, 0, 2), (2, 7, 7), (2, 20, 29)]
    assert abs(found.covered - 306 / 330) < 1e-6


def test_without_a_policy_that_chooses():
    use = PlanUse(PLANS)
    use(episode(0, [0, 1, 1], weights=False))
    found = use.tasks()["reach"]
    assert found.chosen == []
    assert found.stuck == [0, 1, 0]
    assert found.to_json()["states"] == 3


def test_one_rule_says_where_an_episode_got_stuck():
    in_charge = torch.nn.functional.one_hot(torch.tensor([0] * 60 + [2] * 6 + [1] * 3 + [0] * 31), 4)
    assert where_stuck(in_charge, 100) == (0, 2)
    assert where_stuck(in_charge, 40) == (0, 2)
    assert where_stuck(in_charge, 34) == (0, 0), "step 1 was in charge for less than 5 states"
    assert where_stuck(in_charge * 0, 100) == (0, 0)


def test_experts_are_stopped_where_nothing_counts_any_more():
    tasks, plans = ["drawer-open", "reach"], lw.load_plans("MT10")
    whole = PlanUse(plans)
    lw.evaluate(
        lw.ExpertActor(tasks),
        tasks=tasks,
        plans=plans,
        episodes_per_task=2,
        seed=4,
        max_steps=250,
        noise_scale=0.0,
        also_record=["qaf"],
        on_episode=whole,
    )
    assert expert_use(plans, tasks, episodes_per_task=2, seed=4) == whole.tasks()
