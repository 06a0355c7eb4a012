"""Rollouts as pages: the robot moves as in MuJoCo, and a rollout that differs from its seed is noticed."""

import dataclasses
import os
import time

import numpy as np
import pytest
import torch
from recordings import Recording, run, skip_without_graphics_driver
from tensordict.nn import TensorDictSequential

import lw_torchrl as lw
from lw_torchrl.envs.rows import episode_seed
from lw_torchrl.evaluation.diagnose.failure import Failure, Finding, MendedEpisode
from lw_torchrl.record.rollouts import run_recorded
from lw_torchrl.record.tabs import Tabs
from lw_torchrl.record.viewer import open_viewer
from lw_torchrl.suites.metaworld import MetaWorldEngine

PLANS = lw.load_plans("MT10")
SEED = 5
POSE = ("translation", "quaternion")


@pytest.fixture(scope="module")
def pushed():
    """Return one episode of push by scripted skills, 60 steps."""
    return run("push", 60, plans=PLANS)[0]


@pytest.fixture
def failed(pushed):
    """Return the same episode without success."""
    rollout = pushed.clone()
    rollout["next", "success"][:] = False
    return rollout


def logged(path, *rollouts, **kwargs):
    with lw.RerunLogger(path) as logger:
        names = [lw.log_rollout(logger, rollout, **kwargs) for rollout in rollouts]
    return names, Recording(path)


def poses_in_the_file(recording, name, step):
    """Return position and quaternion (w last) of each body, (7,), at a step."""
    frames, poses = Tabs.read(recording.reader).pages[name].frames, {}
    for mesh, frame in frames.items():
        if frame:
            pose = [recording.in_frame(f"/{name}/scene/bodies", frame, part, step) for part in POSE]
        else:  # a body that stands still has its mesh's own pose
            pose = [recording.at(mesh, f"Transform3D:{part}", step)[0] for part in POSE]
        poses[mesh.removeprefix("/meshes/").rpartition("-")[0].replace("\\", "")] = np.concatenate(pose)
    return poses


def check_against_metaworld(recording, name, rollout, steps):
    """Compare the file's poses with those of Meta-World's own environment after the same actions."""
    task, length = lw.MT50[int(rollout["task_id"][0])], len(rollout)
    engine = MetaWorldEngine([task])
    engine.reset([0], [episode_seed(task, SEED, int(rollout["episode"][0]))])
    model = engine.row_model(0).model
    for step in range(length + 1):
        if step in steps:
            expected = engine.poses(0)
            in_file = poses_in_the_file(recording, name, step)
            assert len(in_file) >= 15
            for body, pose in in_file.items():
                number = int(body[5:]) if body.startswith("body-") else model.body(body).id
                np.testing.assert_allclose(pose[:3], expected.position[number], rtol=0, atol=1e-5)
                np.testing.assert_allclose(pose[3:], expected.quaternion[number][[1, 2, 3, 0]], rtol=0, atol=1e-5)
        if step < length:
            engine.step(rollout["next", "executed_action"][step : step + 1].numpy(), np.ones(1, bool))
    engine.close()


@pytest.mark.parametrize("tasks", [("drawer-open", "soccer"), pytest.param(lw.MT50, marks=pytest.mark.slow)])
def test_bodies_have_the_poses_of_mujoco(tmp_path, tasks):
    rollouts = run(tasks, 12)
    names, recording = logged(tmp_path / "a.rrd", rollouts, seed=SEED)
    assert names == [[f"{task}-0" for task in tasks]]
    for name, rollout in zip(names[0], rollouts, strict=True):
        check_against_metaworld(recording, name, rollout, (0, 5, 12))


def test_the_viewer_reports_no_fault(tmp_path, pushed):
    logged(tmp_path / "a.rrd", pushed, plans=PLANS, seed=SEED)
    with skip_without_graphics_driver():
        open_viewer(tmp_path / "a.rrd", tmp_path / "a.png", "800x600", step=10)  # a report of a view would be a warning
    assert (tmp_path / "a.png").read_bytes()[16:24] == (800).to_bytes(4, "big") + (600).to_bytes(4, "big")


def test_a_page_is_small_and_fast(tmp_path):
    rollout = run("door-open", 500)[0]
    with lw.RerunLogger(tmp_path / "a.rrd") as logger:
        lw.log_rollout(logger, rollout, seed=SEED)
    assert os.path.getsize(tmp_path / "a.rrd") < 3e6
    seconds = []
    with lw.RerunLogger(tmp_path / "b.rrd") as logger:
        for _ in range(10):
            start = time.process_time()
            lw.log_rollout(logger, rollout, seed=SEED)
            seconds.append(time.process_time() - start)
    assert os.path.getsize(tmp_path / "b.rrd") < 8e6
    assert min(seconds) < 0.5  # 30 ms of it write, the rest simulates


def test_a_simulation_that_differs_is_warned_about(tmp_path, pushed):
    other = pushed.clone()
    other["next", "executed_action"][20] += 0.01
    with pytest.warns(UserWarning, match=r"push, episode 0 of seed 5 differs at step 21"):
        _, recording = logged(tmp_path / "a.rrd", other, seed=SEED)
    assert "/push-0/scene/gripper" in recording.entities()
    assert not any("/bodies" in entity for entity in recording.entities())
    with pytest.warns(UserWarning, match="at step 0"):
        logged(tmp_path / "b.rrd", pushed, seed=SEED + 1)


def test_the_executed_action_is_recorded(tmp_path, pushed):
    wild = pushed.clone()
    wild["action"] = wild["action"] * 100
    _, recording = logged(tmp_path / "a.rrd", wild, seed=SEED)
    executed = pushed["next", "executed_action"].double()
    np.testing.assert_array_equal(recording.array("/push-0/action", "Scalars:scalars"), executed)
    assert any("/bodies" in entity for entity in recording.entities())


def test_the_target_pose_is_that_of_the_active_skill(tmp_path, pushed):
    _, recording = logged(tmp_path / "a.rrd", pushed, plans=PLANS, seed=SEED)
    steps = PLANS["push"].steps
    active = pushed["skill_weights"].argmax(-1)
    observation = pushed["observation"]
    for row in (0, 30, 59):
        skill = lw.load_skills()[steps[active[row]].skill].for_task("push")
        positions = lw.TASKS["push"].positions(observation[row])
        target = positions[skill.target] + torch.tensor(skill.offset)
        expected = torch.where(torch.tensor(skill.gain) > 0, target, positions[skill.moved])
        arrow = [recording.at("/push-0/scene/target", f"Arrows3D:{part}", row)[0] for part in ("origins", "vectors")]
        np.testing.assert_allclose(np.add(*arrow), expected, atol=1e-6)
        distance = recording.at("/push-0/distance", "Scalars:scalars", row)[0]
        assert distance == pytest.approx(100 * float((expected - positions[skill.moved]).norm()), abs=1e-3)


def test_only_objects_of_the_plan_are_drawn(tmp_path, pushed):
    names, recording = logged(tmp_path / "a.rrd", pushed.exclude("episode"), plans=PLANS)
    assert names == ["push"]
    texts = " ".join(f"{step.condition} {step.skill}" for step in PLANS["push"].steps)
    shown = {e.split("/")[4].replace("\\", "") for e in recording.entities() if e.startswith("/push/scene/objects/")}
    assert shown == {name for name in lw.TASKS["push"].object_names if name in texts}
    assert "/push/scene/gripper" in recording.entities(), "without a seed, a simple hand is drawn"


def failure_of(**changes):
    values = {"step": 1, "skill": PLANS["push"].steps[1].skill, "states": 60, "of": 60, "distance_cm": 10.0}
    finding = Finding("distant step", values)
    failure = Failure("push", SEED, 0, "skill", None, 1, 33, finding, counterfactuals={"skill": True})
    return dataclasses.replace(failure, **changes)


def test_verdict_of_a_failure(tmp_path, failed):
    failure = failure_of(counterfactuals={"skill": True, "plan": False, "query": False})
    _, recording = logged(tmp_path / "a.rrd", failed, plans=PLANS, seed=SEED, policy="mine", failure=failure)
    verdict = recording.text("/push-0/verdict")
    assert verdict.startswith("#### FAILED: skill, the policy executed a skill badly\n\nStep 2, ")
    assert "was active in 60 of the last 60 states and ended 10 cm from its target.  \n" in verdict
    skill = PLANS["push"].steps[1].skill
    assert f"Seen at t = 33 (0.41 s) of 60, in plan step 2, **“{skill}”**." in verdict
    assert "Replacing the plan or the answers did not help." in verdict
    assert "push · episode 0 · seed 5 · mine" in verdict
    assert Tabs.read(recording.reader).opening_step() == 33
    (store,) = recording.reader.blueprints()
    layout = " ".join(str(chunk.to_record_batch()) for chunk in recording.reader.stream(store=store))
    assert "push-0 · mine · failed: skill" in layout


def test_the_repaired_episode_is_a_ghost(tmp_path, pushed, failed):
    mended = pushed.clone()
    mended["observation"][30:, 0] += 0.02  # the two episodes part here
    mended["next", "success"][40] = True
    ghost = MendedEpisode("plan", PLANS["push"], mended[:41].exclude("qaf_plan"))
    failure = failure_of(mended=ghost)
    _, recording = logged(tmp_path / "a.rrd", failed, plans=PLANS, failure=failure)
    verdict = recording.text("/push-0/verdict")
    assert "with the reference plan, succeeds at t = 41 (0.51 s); the two diverge at **t = 30**" in verdict
    steps = [f"ghost{step}" for step in mended[:41]["skill_weights"].argmax(-1).tolist()]
    assert recording.states("/e1/0c_ghost_with_the_reference_plan", 41) == steps
    page = Tabs.read(recording.reader).pages["push-0"]
    assert page.shown[0] == 22
    assert page.states["ghost0"][0] == f"1 {PLANS['push'].steps[0].skill}"


@pytest.mark.parametrize("in_front", [True, False])
def test_exact_answers_are_recorded_with_those_of_an_evaluator(in_front):
    class Never(lw.QueryEvaluator):
        def logits(self, observation, task_id):
            return observation.new_full((*task_id.shape, self.plans.num_steps), -3.0)

    scripted, never = lw.ScriptedSkillActor(PLANS), Never(PLANS)
    actor = TensorDictSequential(never, scripted) if in_front else scripted
    (episode,) = run_recorded(actor, "push", seed=SEED, max_steps=5, evaluator=None if in_front else never)
    assert bool((episode.steps["qaf_logits"] == -3.0).all())
    exact = lw.QAFTransform(PLANS)(episode.steps.select("observation", "task_id"))["qaf"]
    assert torch.equal(episode.steps["qaf"], exact)
    assert bool(exact.any())


def test_an_overview_lists_failures_first_and_counts_causes(tmp_path, failed):
    won = failed.clone()
    won["next", "success"][39] = True
    with lw.RerunLogger(tmp_path / "a.rrd") as logger:
        lw.log_rollout(logger, won, PLANS, policy="mine")
        lw.log_rollout(logger, failed, PLANS, policy="mine", failure=failure_of())
    recording = Recording(tmp_path / "a.rrd")
    title, _, who, _, *rows = recording.text("/overview/table").splitlines()
    assert (title, who) == ("#### 1 of 2 episodes failed · skill 1", "By mine.")
    assert rows == [
        "|  | episode | cause | ended |",
        "|-|-|-|-|",
        "| ✗ | push-0-2 · episode 0 | skill | t = 60 (0.75 s) |",
        "| ✓ | push · episode 0 |  | t = 40 (0.50 s) |",
    ]
    assert list(recording.shown_tabs()) == ["Overview", "push-0-2 · failed: skill", "push-0 · success at 40"]
    assert Tabs.read(recording.reader).opening_step() == 33


def test_verdict_without_a_cause_describes_the_end(tmp_path, pushed, failed):
    failed["qaf"][:, 1] = False
    _, recording = logged(tmp_path / "a.rrd", failed, plans=PLANS)
    verdict = recording.text("/push-0/verdict")
    assert verdict.startswith("#### FAILED in 60 steps (0.75 s)")
    last = int(pushed["skill_weights"][-1].argmax())
    assert f"At the end plan step {last + 1}, **“{PLANS['push'].steps[last].skill}”**, was active" in verdict
    assert f"condition 2, “{PLANS['push'].steps[1].condition}”" in verdict
    assert Tabs.read(recording.reader).opening_step() == 60


def test_verdict_of_a_success(tmp_path, pushed):
    succeeded = pushed.clone()
    succeeded["next", "success"][:] = (torch.arange(60) == 40)[:, None]
    _, recording = logged(tmp_path / "a.rrd", succeeded)
    verdict = recording.text("/push-0/verdict")
    assert verdict.startswith("#### SUCCESS at t = 41 (0.51 s) of 60")
    assert "did not last: the task was solved in 1 steps" in verdict
    assert Tabs.read(recording.reader).opening_step() == 41
