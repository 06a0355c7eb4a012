"""The examples: short, composed by hand from the library's parts, and they run."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from rerun.chunk import RrdReader

import lw_torchrl as lw

EXAMPLES = Path(__file__).parent.parent / "examples"
TRAIN_BC = EXAMPLES / "train_bc.py"
TOUR = EXAMPLES / "tour.ipynb"


def names(path):
    """Every name and attribute a file mentions, and every module it imports."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Attribute):
            found.add(node.attr)
        elif isinstance(node, ast.Name):
            found.add(node.id)
        elif isinstance(node, ast.ImportFrom):
            found |= {node.module or "", *(alias.name for alias in node.names)}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found


@pytest.mark.parametrize(
    "path", sorted([*EXAMPLES.glob("*.py"), *EXAMPLES.glob("online/*.py")]), ids=lambda path: path.name
)
def test_examples_are_at_most_one_page(path):
    lines = path.read_text("utf-8").splitlines()
    longer = {"offline": 120, "rerun": 120, "suite": 155}
    assert len(lines) <= (170 if path.parent.name == "online" else longer.get(path.name.partition("_")[0], 80))
    assert max(map(len, lines)) <= 120


def test_train_bc_uses_no_trainer():
    found = names(TRAIN_BC)
    assert {"BCLoss", "PlanConditionedActor", "LanguageWorldExperienceReplay", "QAFTransform"} <= found
    assert not any("Trainer" in name or "trainers" in name for name in found)
    assert not any(name.startswith("lw_torchrl.") for name in found), "the public names are enough"


def run(path, folder, *options):
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / path), *map(str, options)],
        cwd=folder,
        env={**os.environ, "TMPDIR": str(folder), "RAY_TMPDIR": tempfile.gettempdir()},  # for sockets a short one
        capture_output=True,
        text=True,
        timeout=240,
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert "Warning" not in done.stderr
    return done


@pytest.mark.slow
def test_other_environments_train(tmp_path):
    pytest.importorskip("gymnasium_robotics")
    done = run("any_environment.py", tmp_path, "--frames", 500)
    assert "500 steps, the last episode's reward" in done.stdout
    assert not any("lw_torchrl.envs" in name for name in names(EXAMPLES / "any_environment.py"))


@pytest.mark.slow
def test_an_own_robot_is_checked_trained_and_recorded(tmp_path):
    done = run("your_robot/your_robot.py", tmp_path, "--steps", 20, "--episodes", 2)
    assert "arm/touch-red" in done.stdout
    assert (tmp_path / "runs/arm/policy.safetensors").is_file()
    assert len(RrdReader(tmp_path / "runs/arm/arm.rrd").recordings()) == 1


@pytest.mark.slow
def test_plain_pytorch_trains_on_an_exported_dataset(tmp_path):
    done = run("plain_pytorch.py", tmp_path, "--steps", 500, "--demonstrations", 1, "--episodes", 1)
    assert "step   500  loss" in done.stdout
    assert "drawer-open" in done.stdout
    assert not any("replay" in name.lower() or "Trainer" in name for name in names(EXAMPLES / "plain_pytorch.py"))


@pytest.mark.slow
def test_fetch_learns_from_demonstrations(tmp_path):
    pytest.importorskip("gymnasium_robotics")
    done = run("fetch_few_shot.py", tmp_path, "--demonstrations", 1, "--steps", 3, "--episodes", 1)
    assert "seed 0: fetch/pick-and-place" in done.stdout
    assert (tmp_path / "runs/fetch-few-shot/seed0/policy.safetensors").is_file()


@pytest.mark.slow
def test_ppo_runs(tmp_path):
    done = run("ppo.py", tmp_path, "--updates", 2, "--rows", 4, "--horizon", 20, "--clone", 5)
    assert "update   1  reward" in done.stdout
    assert "window-open" in done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("name", ["td3_with_demonstrations", "sac_with_demonstrations", "expert_iteration"])
def test_policy_trains_online(tmp_path, name):
    """On an easy task, so that the few steps hold successes to learn from."""
    task = ["--task", "button-press-topdown", "--cloning-steps", 150, "--max-steps", 100]
    training = ["--frames", 2_000, "--learning-starts", 500, "--utd", 0.05, "--episodes", 2, "--out", "out"]
    warm_up = [] if name == "expert_iteration" else ["--critic-warm-up", 10]
    done = run(f"online/{name}.py", tmp_path, *task, *training, *warm_up)
    assert "step   2000/2000: " in done.stdout
    assert "button-press-topdown: success " in done.stdout
    policy = lw.load_actor(tmp_path / "out" / "button-press-topdown-seed0" / "policy.safetensors")
    assert policy.tasks == ("button-press-topdown",)


@pytest.mark.slow
def test_training_is_recorded(tmp_path):
    options = ["--steps", 20, "--demonstrations", 1, "--rollouts", 2, "--length", 30]
    done = run("rerun_training.py", tmp_path, *options)
    assert [line.split()[1] for line in done.stdout.splitlines() if line.startswith("step ")] == ["10", "20"]
    recording = RrdReader(tmp_path / "runs" / "rerun_training" / "training.rrd")
    found = {chunk.entity_path for chunk in recording.stream()}
    assert {"/metrics/loss/bc", "/metrics/success/mean", "/histograms/action", "/hparams"} <= found
    assert {f"/{task}\\ after\\ {step}/action" for task in ("drawer-open", "window-open") for step in (10, 20)} <= found


@pytest.mark.slow
def test_co_learning_runs_on_custom_data(tmp_path):
    done = run("co_learning.py", tmp_path, "--steps", 20, "--demonstrations", 1, "--episodes", 1)
    assert "the target's rows 50" in done.stdout
    for task in ("window-open", "drawer-open", "door-open"):
        assert any(line.startswith(f"{task} ") for line in done.stdout.splitlines()), "the table"
    left = {path.name for path in tmp_path.iterdir() if not path.name.startswith("torchinductor")}
    assert not left, "it leaves nothing behind"


@pytest.mark.slow
def test_offline_rl_runs(tmp_path):
    done = run("offline_rl.py", tmp_path, "--steps", 3, "--episodes", 1, "--data", 6)
    lines = done.stdout.splitlines()
    assert [line.split(":")[0] for line in lines[-2:]] == ["by advantage", "successes cloned"]
    left = {path.name for path in tmp_path.iterdir() if not path.name.startswith("torchinductor")}
    assert not left, "it leaves nothing behind"
    assert {"ExpectileValueLoss", "AdvantageWeightedLoss", "SoftUpdate"} <= names(EXAMPLES / "offline_rl.py")


@pytest.mark.slow
def test_policy_is_exported(tmp_path):
    lw.save_actor(lw.PlanConditionedActor(lw.load_plans("MT10")), tmp_path / "policy.safetensors")
    done = run("export_policy.py", tmp_path, "policy.safetensors", "policy.pt2")
    assert done.stdout.count("at most 0.0e+00 away") == 3
    assert (tmp_path / "policy.pt2").is_file()


@pytest.mark.slow
def test_torchrls_trainer_runs(tmp_path):
    done = run("torchrl_trainer.py", tmp_path, "--updates", 3, "--rows", 4, "--horizon", 25)
    assert len(done.stdout.split("update:")[1].splitlines()[0].split()) == 3
    logged = tmp_path / "runs" / "torchrl_trainer" / "ppo" / "scalars"
    for name in ("reward", "success", "loss_objective"):
        lines = (logged / f"{name}.csv").read_text("utf-8").splitlines()
        assert [line.split(",")[0] for line in lines] == ["100", "200", "300"]
    assert lw.load_actor(tmp_path / "runs" / "torchrl_trainer" / "policy.safetensors").distribution == "normal"


@pytest.mark.slow
def test_ray_collects_experience(tmp_path):
    pytest.importorskip("ray")
    done = run("collect_on_ray.py", tmp_path, "--workers", 2, "--batches", 4)
    assert "batch 3: 200 steps" in done.stdout


def test_train_bc_runs(tmp_path):
    done = run("train_bc.py", tmp_path, "--steps", 20, "--demonstrations", 1, "--episodes", 1)
    assert "step     0  loss" in done.stdout
    for task in ("drawer-open", "window-open"):
        assert any(line.startswith(f"{task} ") for line in done.stdout.splitlines()), "the table"
        assert any(line.startswith(f"{task}: ") for line in done.stdout.splitlines()), "the skills"
    left = {path.name for path in tmp_path.iterdir() if not path.name.startswith("torchinductor")}
    assert not left, "it leaves nothing behind"


def shown(path):
    """What the cells of a notebook show: the kinds of their outputs, and their text."""
    cells = json.loads(path.read_text("utf-8"))["cells"]
    outputs = [output for cell in cells for output in cell.get("outputs", ())]
    return [kind for output in outputs for kind in output.get("data", [output["output_type"]])], str(outputs)


def test_tour_is_stored_with_its_outputs():
    kinds, text = shown(TOUR)
    assert kinds.count("image/png") == 4
    assert "error" not in kinds
    assert "lw-torchrl view" in text
    assert "stderr" not in text
    assert TOUR.stat().st_size < 300_000


@pytest.mark.slow
def test_tour_runs_from_top_to_bottom(tmp_path):
    pytest.importorskip("nbclient")
    script = EXAMPLES.parent / "docs" / "hooks" / "tour.py"
    done = subprocess.run(
        [sys.executable, str(script), "shown.ipynb"], cwd=tmp_path, capture_output=True, text=True, timeout=400
    )
    assert done.returncode == 0, done.stderr
    assert shown(tmp_path / "shown.ipynb")[0] == shown(TOUR)[0]
