"""Rollouts as pages: the robot stands where MuJoCo has it, and a rollout that is another episode is noticed."""

from __future__ import annotations

import dataclasses
import os
import time
from itertools import product

import numpy as np
import pytest
import torch
from recordings import Recording, run
from tensordict.nn import TensorDictSequential

import lw_torchrl as lw
from lw_torchrl.envs.seeding import episode_seed
from lw_torchrl.evaluation import EpisodeResult, EvaluationResult
from lw_torchrl.evaluation.diagnose.failure import ActiveStep, Failure, MendedEpisode
from lw_torchrl.record.rollouts import run_recorded
from lw_torchrl.record.tabs import Tabs
from lw_torchrl.record.viewer import open_viewer
from lw_torchrl.suites.metaworld import MetaWorldEngine

PLANS = lw.load_plans("MT10")
SEED = 5


@pytest.fixture(scope="module")
def pushed():
    """One episode of push by scripted skills, 60 steps."""
    return run("push", 60, plans=PLANS)[0]


@pytest.fixture
def failed(pushed):
    """The same without success."""
    rollout = pushed.clone()
    rollout["next", "success"][:] = False
    return rollout


def logged(path, *rollouts, **kwargs):
    with lw.RerunLogger(path) as logger:
        names = [lw.log_rollout(logger, rollout, **kwargs) for rollout in rollouts]
    return names, Recording(path)


POSE = ("translation", "quaternion")


def poses_in_the_file(found, name, step):
    """Body to (7,) position and quaternion (w last) at a step."""
    frames, poses = Tabs.read(found.reader).pages[name].frames, {}
    for mesh, frame in frames.items():
        if frame:
            pose = [found.in_frame(f"/{name}/scene/bodies", frame, part, step) for part in POSE]
        else:  # a body that stands still has its mesh's own pose
            pose = [found.at(mesh, f"Transform3D:{part}", step)[0] for part in POSE]
        poses[mesh.removeprefix("/meshes/").rpartition("-")[0].replace("\\", "")] = np.concatenate(pose)
    return poses


def check_against_metaworld(found, name, rollout, steps):
    """Meta-World's own environment, given the same actions, has its bodies where the file says."""
    task, length = lw.MT50[int(rollout["task_id"][0])], len(rollout)
    engine = MetaWorldEngine([task])
    engine.reset([0], [episode_seed(task, SEED, int(rollout["episode"][0]))])
    model = engine.model(0).model
    for step in range(length + 1):
        if step in steps:
            expected = engine.poses(0)
            in_file = poses_in_the_file(found, name, step)
            assert len(in_file) >= 15
            for body, pose in in_file.items():
                number = int(body[5:]) if body.startswith("body-") else model.body(body).id
                np.testing.assert_allclose(pose[:3], expected.position[number], rtol=0, atol=1e-5)
                np.testing.assert_allclose(pose[3:], expected.quaternion[number][[1, 2, 3, 0]], rtol=0, atol=1e-5)
        if step < length:
            engine.step(rollout["next", "executed_action"][step : step + 1].numpy(), np.ones(1, bool))
    engine.close()


@pytest.mark.parametrize("tasks", [("drawer-open", "soccer"), pytest.param(lw.MT50, marks=pytest.mark.slow)])
def test_bodies_stand_where_mujoco_has_them(tmp_path, tasks):
    rollouts = run(tasks, 12)
    names, found = logged(tmp_path / "a.rrd", rollouts, seed=SEED)
    assert names == [[f"{task}-0" for task in tasks]]
    for name, rollout in zip(names[0], rollouts, strict=True):
        check_against_metaworld(found, name, rollout, (0, 5, 12))


def test_the_viewer_has_nothing_to_complain_of(tmp_path, pushed):
    logged(tmp_path / "a.rrd", pushed, plans=PLANS, seed=SEED)
    try:
        open_viewer(tmp_path / "a.rrd", tmp_path / "a.png", "800x600")  # a report of a view is a warning
    except RuntimeError as error:
        if "no graphics driver" in str(error):
            pytest.skip("no graphics driver")
        raise


def test_an_episode_is_small_and_quick(tmp_path):
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


def test_another_simulation_is_noticed(tmp_path, pushed):
    other = pushed.clone()
    other["next", "executed_action"][20] += 0.01
    with pytest.warns(
        UserWarning, match=r"push, episode 0 of seed 5, again gives other numbers at step 21: number \d+ is .* off"
    ):
        _, found = logged(tmp_path / "a.rrd", other, seed=SEED)
    assert "/push-0/scene/gripper" in found.entities()
    assert not any("/bodies" in entity for entity in found.entities())
    with pytest.warns(UserWarning, match="at step 0"):
        logged(tmp_path / "b.rrd", pushed, seed=SEED + 1)


def test_without_a_seed_nothing_is_simulated(tmp_path, pushed):
    names, found = logged(tmp_path / "a.rrd", pushed.exclude("episode"), plans=PLANS)
    assert names == ["push"]
    assert "/push/scene/gripper" in found.entities()


def test_the_executed_action_counts(tmp_path, pushed):
    wild = pushed.clone()
    wild["action"] = wild["action"] * 100
    _, found = logged(tmp_path / "a.rrd", wild, seed=SEED)
    np.testing.assert_array_equal(
        found.array("/push-0/action", "Scalars:scalars"), pushed["next", "executed_action"].double()
    )
    assert any("/bodies" in entity for entity in found.entities())


def test_the_target_pose_is_the_skills(tmp_path, pushed):
    _, found = logged(tmp_path / "a.rrd", pushed, plans=PLANS, seed=SEED)
    steps = PLANS["push"].steps
    active = pushed["skill_weights"].argmax(-1)
    observation = pushed["observation"]
    for row in (0, 30, 59):
        skill = lw.load_skills()[steps[active[row]].skill].for_task("push")
        positions = lw.TASKS["push"].positions(observation[row])
        aimed = positions[skill.target] + torch.tensor(skill.offset)
        expected = torch.where(torch.tensor(skill.gain) > 0, aimed, positions[skill.moved])
        start, way = (found.at("/push-0/scene/target", f"Arrows3D:{part}", row)[0] for part in ("origins", "vectors"))
        shown = np.add(start, way)
        np.testing.assert_allclose(shown, expected, atol=1e-6)
        distance = found.at("/push-0/distance", "Scalars:scalars", row)[0]
        assert distance == pytest.approx(100 * float((expected - positions[skill.moved]).norm()), abs=1e-3)


def test_objects_that_the_plan_speaks_of_are_named(tmp_path, pushed):
    _, found = logged(tmp_path / "a.rrd", pushed, plans=PLANS)
    texts = " ".join(f"{step.condition} {step.skill}" for step in PLANS["push"].steps)
    shown = {e.split("/")[4].replace("\\", "") for e in found.entities() if e.startswith("/push-0/scene/objects/")}
    assert shown == {name for name in lw.TASKS["push"].object_names if name in texts}


def failure_of(rollout, **changes):
    finding = ActiveStep(1, PLANS["push"].steps[1].skill, 60, 60, 0.1)
    failure = Failure("push", SEED, 0, "skill", None, 1, 33, finding, counterfactuals={"skill": True})
    return dataclasses.replace(failure, **changes)


def test_a_failure_is_the_verdict(tmp_path, failed):
    why = failure_of(failed, counterfactuals={"skill": True, "plan": False, "query": False})
    _, found = logged(tmp_path / "a.rrd", failed, plans=PLANS, seed=SEED, policy="mine", failure=why)
    verdict = found.text("/push-0/verdict")
    assert verdict.startswith("#### FAILED: skill, the policy executed a skill badly\n\nStep 2, ")
    assert "was active in 60 of the last 60 states and ended 10 cm from its target.  \n" in verdict
    skill = PLANS["push"].steps[1].skill
    assert f"Seen at t = 33 (0.41 s) of 60, in plan step 2, **“{skill}”**." in verdict
    assert "Replacing the plan or the answers did not help." in verdict
    assert "push · episode 0 · seed 5 · mine" in verdict
    assert Tabs.read(found.reader).opening_step() == 33
    (store,) = found.reader.blueprints()
    layout = " ".join(str(chunk.to_record_batch()) for chunk in found.reader.stream(store=store))
    assert "push-0 · mine · failed: skill" in layout


def test_what_mends_a_failure_is_a_ghost_beside_it(tmp_path, pushed, failed):
    mended = pushed.clone()
    mended["observation"][30:, 0] += 0.02  # what parts them
    mended["next", "success"][40] = True
    ghost = MendedEpisode("plan", PLANS["push"], mended[:41].exclude("qaf_plan"))
    why = failure_of(failed, mended=ghost)
    _, found = logged(tmp_path / "a.rrd", failed, plans=PLANS, failure=why)
    verdict = found.text("/push-0/verdict")
    assert (
        "**The blue ghost**, with the reference plan, succeeds at t = 41 (0.51 s); they part at **t = 30**" in verdict
    )
    steps = [f"ghost{step}" for step in mended[:41]["skill_weights"].argmax(-1).tolist()]
    assert found.states("/e1/0c_ghost_with_the_reference_plan", 41) == steps
    page = Tabs.read(found.reader).pages["push-0"]
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
    result = EvaluationResult(
        {"tasks": ["push"], "episodes_per_task": 1, "max_steps": 60, "seed": SEED},
        (EpisodeResult("push", 0, False, None, None, None),),
        failures=(failure_of(failed),),
    )
    with lw.RerunLogger(tmp_path / "a.rrd") as logger:
        lw.log_rollout(logger, won, PLANS, policy="mine")
        lw.log_rollout(logger, failed, PLANS, policy="mine", failure=failure_of(failed))
        logger.show_causes(result)
    found = Recording(tmp_path / "a.rrd")
    title, _, who, _, *rows = found.text("/overview/table").splitlines()
    assert (title, who) == ("#### 1 of 2 episodes failed · skill 1", "By mine.")
    assert rows == [
        "|  | episode | cause | ended |",
        "|-|-|-|-|",
        "| ✗ | push-0-2 · episode 0 | skill | t = 60 (0.75 s) |",
        "| ✓ | push · episode 0 |  | t = 40 (0.50 s) |",
    ]
    assert list(found.shown_tabs()) == ["Overview", "push-0-2 · failed: skill", "push-0 · success at 40"]
    assert found.shown_tabs()["Overview"] == ["Episodes", "Causes"]
    assert found.values("/overview/causes", "EncodedImage:media_type") == [["image/png"]]
    assert Tabs.read(found.reader).opening_step() == 33


def test_a_ghost_of_the_robot_moves_what_moves(tmp_path, pushed, failed):
    why = failure_of(failed, mended=MendedEpisode("policy", PLANS["push"], pushed))
    _, found = logged(tmp_path / "a.rrd", failed, plans=PLANS, seed=SEED, failure=why)
    frames = Tabs.read(found.reader).pages["push-0"].frames
    ghosts = {mesh: body for mesh, body in frames.items() if mesh.startswith("/ghosts/")}
    moving = {mesh: body for mesh, body in frames.items() if body and mesh not in ghosts}
    assert {mesh.replace("ghosts", "meshes") for mesh in ghosts} == set(moving)

    def poses(kind, bodies, part, step):
        """A part of each body's pose at a step."""
        entity = f"/push-0/scene/{kind}"
        return {body.rpartition("/")[2]: found.in_frame(entity, body, part, step) for body in bodies.values()}

    for part, step in product(POSE, (0, 17, 60)):
        assert poses("ghost", ghosts, part, step) == poses("bodies", moving, part, step)


def test_without_a_failure_the_verdict_tells_facts(tmp_path, pushed, failed):
    failed["qaf"][:, 1] = False
    _, found = logged(tmp_path / "a.rrd", failed, plans=PLANS)
    verdict = found.text("/push-0/verdict")
    assert verdict.startswith("#### FAILED in 60 steps (0.75 s)")
    last = int(pushed["skill_weights"][-1].argmax())
    assert f"At the end plan step {last + 1}, **“{PLANS['push'].steps[last].skill}”**, was active" in verdict
    assert f"condition 2, “{PLANS['push'].steps[1].condition}”" in verdict
    assert Tabs.read(found.reader).opening_step() == 60


def test_a_success_is_the_verdict(tmp_path, pushed):
    succeeded = pushed.clone()
    succeeded["next", "success"][:] = (torch.arange(60) == 40)[:, None]
    _, found = logged(tmp_path / "a.rrd", succeeded)
    verdict = found.text("/push-0/verdict")
    assert verdict.startswith("#### SUCCESS at t = 41 (0.51 s) of 60")
    assert "did not last: the task was done in 1 steps" in verdict
    assert Tabs.read(found.reader).opening_step() == 41


@pytest.mark.parametrize(
    ("change", "kwargs", "message"),
    [
        (lambda r: r.exclude("task_id"), {}, "task_id are needed, got"),
        (lambda r: r.set("episode", torch.arange(60) // 30), {}, r"one episode of one task, got 'episode' \[0, 1\]"),
        (lambda r: r.set("qaf_plan", r["qaf_plan"] + 1), {"plans": PLANS}, r"\['qaf'\] answers another plan of 'push'"),
        (lambda r: r, {"plans": lw.Plans([PLANS["reach"]])}, "plans lack push"),
        (lambda r: r, {"failure": failure_of(None, episode=3)}, "failure must be of the rollout's episode, push 0"),
    ],
)
def test_wrong_rollouts_of_tasks_are_named(tmp_path, pushed, change, kwargs, message):
    with lw.RerunLogger(tmp_path / "a.rrd") as logger:
        with pytest.raises(ValueError, match=message):
            lw.log_rollout(logger, change(pushed.clone()), **kwargs)
        assert logger.episodes == []
