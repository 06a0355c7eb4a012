"""Which step failed episodes came to and not beyond, from episodes made up by hand."""

import pytest
import torch
from tensordict import TensorDict

import lw_torchrl as lw
from lw_torchrl.envs.episodes import FinishedEpisode
from lw_torchrl.evaluation import PlanUse, stuck_steps, stuck_table, weakest_step

PLANS = lw.load_plans("MT10")


def episode(steps, success=False, task="pick-place", weights=True):
    """One whose step t has only condition ``steps[t]`` true, none for -1, and takes that step's skill."""
    chosen = torch.tensor(steps)
    qaf = torch.nn.functional.one_hot(chosen.clamp(min=0), PLANS.num_steps).bool() & (chosen >= 0)[:, None]
    done = torch.zeros(len(steps), 1, dtype=torch.bool)
    done[-1] = success
    found = TensorDict({"qaf": qaf, "next": TensorDict({"success": done}, [len(steps)])}, [len(steps)])
    if weights:
        found["skill_weights"] = torch.nn.functional.one_hot(chosen.clamp(min=0), PLANS.num_steps).float()
    return FinishedEpisode(task, 0, found)


DROPPED = [0] * 20 + [1] * 10 + [2] * 5 + [3] * 8 + [0] * 60
SLIPPED = [0] * 20 + [1] * 10 + [2] * 60 + [3] * 4


@pytest.mark.parametrize("weights", [True, False])
def test_what_is_dropped_was_lost_where_it_was_carried(weights):
    use = PlanUse(PLANS)
    for steps in (DROPPED, DROPPED, SLIPPED):
        use(episode(steps, weights=weights))
    use(episode([0, 1, 2, 3], success=True, weights=weights))
    found = use.tasks()["pick-place"]
    assert (found.failed, found.stuck) == (3, [2, 0, 1, 0])
    assert found.furthest == [0, 0, 1, 2], "four states are not yet a while"
    weakest = weakest_step(use)
    assert (weakest.task, weakest.step, weakest.furthest, weakest.stuck) == ("pick-place", 3, 2, 0)
    assert weakest.skill == "move the puck to the target location"


def test_an_episode_too_short_for_a_while_and_one_that_no_condition_covers():
    use = PlanUse(PLANS)
    use(episode([0, 1, 1]))
    use(episode([-1] * 30, weights=False, task="push"))
    assert use.tasks()["pick-place"].furthest == [0, 1, 0, 0]
    assert use.tasks()["push"].furthest == [1, 0, 0, 0]


def test_the_first_of_equals_of_a_task_or_of_all():
    use = PlanUse(PLANS)
    use(episode([1] * 9))
    use(episode([0] * 9))
    use(episode([2] * 9, task="push"))
    assert weakest_step(use, "pick-place").step == 0
    assert weakest_step(use, "push").step == 2
    assert weakest_step(use).task == "pick-place"
    with pytest.raises(ValueError, match="task must be one of 'pick-place', 'push', got 'puhs'; did you mean 'push'"):
        weakest_step(use, "puhs")


def test_where_nothing_failed_nothing_is_weakest():
    use = PlanUse(PLANS)
    with pytest.raises(ValueError, match="none failed"):
        weakest_step(use)
    use(episode([0, 1], success=True))
    with pytest.raises(ValueError, match="use must hold failed episodes"):
        weakest_step(use, "pick-place")


def test_the_table_has_a_line_for_each_step():
    use = PlanUse(PLANS)
    use(episode(DROPPED))
    lines = stuck_table(stuck_steps(use)).splitlines()
    assert len(lines) == 1 + len(PLANS["pick-place"].steps)
    assert lines[1].startswith("pick-place     1      1 of 1      0 of 1  place the gripper above the puck ")
    assert lines[4].startswith("pick-place     4      0 of 1      1 of 1  move the puck to the target location")
    assert lines[4].endswith(str(PLANS["pick-place"].steps[3].condition))
