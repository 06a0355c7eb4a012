"""The example's suite of robosuite: its check, its seeds, its plans, and the script itself."""

from dataclasses import replace
from pathlib import Path

import pytest
from commands import python_process

import lw_torchrl as lw
from lw_torchrl.modules import Concat, MLPDecoder, ObservationFeatures, RoleFeatures
from lw_torchrl.suites import check_suite

pytestmark = pytest.mark.slow
EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture(scope="module")
def suite():
    pytest.importorskip("robosuite")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(EXAMPLES)
        from suite_robosuite import make_suite
    return make_suite("Panda")


def test_check_finds_nothing_wrong(suite):
    """One task is enough: the others have the same arm, gripper and frame."""
    lift = replace(suite, tasks={"robosuite/lift": suite.tasks["robosuite/lift"]}, plans=None)
    assert [finding for finding in check_suite(lift) if not finding.right] == []


@pytest.mark.parametrize("task", ["lift", "stack", "door"])
def test_plans_with_scripted_skills_succeed(task, suite):
    actor = lw.ScriptedSkillActor(suite.plans, skills=suite.skills)
    run = {"episodes_per_task": 1, "seed": 2000, "noise_scale": 0.0, "stop_at_success": True, "progress": False}
    assert lw.evaluate(actor, tasks=f"robosuite/{task}", suite=suite, **run).mean_success == 1.0


def test_example_runs_a_metaworld_policy(suite, tmp_path):
    plans = lw.canonical_plans(lw.load_plans("MT10"))
    features = Concat(ObservationFeatures("opening"), RoleFeatures(plans))
    actor = lw.PlanConditionedActor(plans, features=features, decoder=MLPDecoder(width=8))
    lw.save_actor(actor, tmp_path / "policy.safetensors")
    options = ["--episodes", "1", "--steps", "5", "--arms", "Panda", "IIWA"]
    done = python_process(EXAMPLES / "suite_robosuite.py", tmp_path / "policy.safetensors", *options, timeout=240)
    assert (done.returncode, done.stdout) == (0, "Panda lift: 0.00\nIIWA lift: 0.00\n"), done.stderr
    assert "Warning" not in done.stderr
    assert "robosuite" not in done.stderr
