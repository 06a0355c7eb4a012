"""PlanUse: its shares and counts, for episodes made by hand."""

import pytest
import torch
from tensordict import TensorDict

import lw_torchrl as lw
from lw_torchrl.envs.episodes import FinishedEpisode
from lw_torchrl.evaluation.plan_use import PlanUse, expert_use

PLANS = {"reach": lw.load_plans("MT10")["reach"]}  # three steps


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
    use = PlanUse(PLANS)
    use(episode(0, [0] * 10 + [1] * 5 + [2] * 100, success_at=14))
    reach = use.tasks()["reach"]
    assert reach.states == 35
    assert reach.true == pytest.approx([10 / 35, 5 / 35, 20 / 35])
    assert reach.chosen == reach.true
    assert (reach.covered, reach.num_true, reach.failed, reach.stuck) == (1.0, 1.0, 0, [0, 0, 0])


def test_gaps_and_stuck_steps_of_failures_are_counted():
    use = PlanUse(PLANS)
    use(episode(0, [0] * 30 + [1] * 60 + [-1] * 10))
    use(episode(1, [2] * 200))
    use(episode(2, [-1] * 3 + [0] * 4 + [-1] + [0] * 12 + [-1] * 30, success_at=29))
    reach = use.tasks()["reach"]
    assert reach.failed == 2
    assert reach.stuck == [0, 1, 1]
    assert reach.gaps == [(0, 90, 99), (2, 0, 2), (2, 7, 7), (2, 20, 29)]
    assert abs(reach.covered - 306 / 330) < 1e-6


def test_true_conditions_count_where_no_step_is_chosen():
    use = PlanUse(PLANS)
    use(episode(0, [0, 1, 1], weights=False))
    reach = use.tasks()["reach"]
    assert reach.chosen == []
    assert reach.stuck == [0, 1, 0]
    assert reach.to_json()["states"] == 3


def test_experts_stop_after_the_states_that_count():
    tasks, plans = ["drawer-open", "reach"], lw.load_plans("MT10")
    whole, options = PlanUse(plans), {"seed": 4, "max_steps": 250, "noise_scale": 0.0, "also_record": ["qaf"]}
    lw.evaluate(lw.ExpertActor(tasks), tasks=tasks, plans=plans, episodes_per_task=2, on_episode=whole, **options)
    assert expert_use(plans, tasks, episodes_per_task=2, seed=4) == whole.tasks()
