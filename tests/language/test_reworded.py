"""The reworded zero-shot plans: other words of MT10's for steps that lift and lower, and nothing else."""

from pathlib import Path

import lw_torchrl as lw

REWORDED = Path(__file__).parents[2] / "examples" / "reworded"


def test_only_words_differ_and_they_are_those_of_mt10():
    shipped, words = lw.load_plans("MT50", skills="MT10"), set(lw.load_plans("MT10").skills)
    reworded = lw.load_plans(REWORDED)
    assert len(reworded) == 10
    assert not {*reworded} & {*lw.MT10}
    for task, plan in reworded.items():
        assert [str(step.condition) for step in plan.steps] == [str(step.condition) for step in shipped[task].steps]
        assert {step.skill for step in plan.steps} <= words
        changed = {(old.skill, new.skill) for old, new in zip(shipped[task].steps, plan.steps, strict=True)}
        changed = {pair for pair in changed if pair[0] != pair[1]}
        assert changed <= {
            ("move the puck to the target location", "place the gripper above the button"),
            ("move the puck to the target location", "push the button down"),
            ("move the gripper toward the reach target", "place the gripper above the button"),
        }
        assert changed
