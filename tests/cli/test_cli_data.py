"""``lw-torchrl collect`` and ``data``: collect, summarise, check and convert datasets."""

import json
import re
import shutil
import statistics
from functools import partial

import numpy as np
import pytest
import torch
from commands import document, fails, run

import lw_torchrl as lw
from lw_torchrl.cli.main import main
from lw_torchrl.data.dataset import load_rows


def collect(root, **options):
    options = {"tasks": ["push", "reach"], "episodes_per_task": 3, "max_steps": 34, "progress": False, **options}
    return lw.collect_demonstrations(root=root, **options)


@pytest.fixture(scope="module")
def datasets(tmp_path_factory):
    root = tmp_path_factory.mktemp("shown")
    return [
        collect(root / "good", noise_scale=(0.0, 0.3), noise_hold=7, redraw_failures=False),
        collect(root / "mixed", policy="noisy-30", seed=5),
        collect(root / "random", tasks="reach", policy="random"),
    ]


def by_hand(episodes):
    """Summarise pairs of an episode's description and the rows of its dataset."""
    returns = [
        rows["next", "reward_dense"][info.start : info.start + info.length].flatten().double().sum().item()
        for info, rows in episodes
    ]
    first = sorted(info.first_success for info, _ in episodes if info.success)
    return {
        "episodes": len(episodes),
        "steps": sum(info.length for info, _ in episodes),
        "success": len(first) / len(episodes),
        "first_success": {"median": statistics.median(first), "min": first[0], "max": first[-1]} if first else None,
        "dense_return": {
            "mean": pytest.approx(statistics.mean(returns), rel=1e-4),
            "quartiles": pytest.approx(np.quantile(returns, [0.25, 0.5, 0.75]).tolist(), rel=1e-4),
        },
    }


def test_summary_of_a_mixture_equals_one_by_hand(capsys, datasets):
    shown = document(capsys, "data show", *[dataset.root for dataset in datasets])
    every = [(data.config.behaviour, info, load_rows(data)) for data in datasets for info in data.episodes]
    assert shown["all"] == {"label": "all", **by_hand([pair for _, *pair in every])}
    for row in shown["tasks"]:
        assert row == {"label": row["label"]} | by_hand([pair for _, *pair in every if pair[0].task == row["label"]])
    assert [row["label"] for row in shown["behaviours"]] == ["noisy", "noisy-30", "random"]
    for row in shown["behaviours"]:
        assert row == {"label": row["label"]} | by_hand([pair for label, *pair in every if label == row["label"]])
    printed = run(capsys, "data", "show", *[dataset.root for dataset in datasets])
    assert re.search(r"^random +3 +102 +0\.00 +never ", printed, re.MULTILINE)
    assert "behaviour  noisy (expert), in metaworld" in printed
    assert "episodes   3 of each task, seed 0, at most 34 steps\n" in printed
    assert "noise      0, 0.3; held for 7 steps, on the gripper x0.2" in printed


def test_check_finds_a_damaged_episode(capsys, datasets, tmp_path):
    printed = run(capsys, "data", "show", datasets[0].root, datasets[1].root, "--check")
    assert printed.endswith("\nall checksums match\n")
    root = shutil.copytree(datasets[1].root, tmp_path / "demos")
    path = root / "data" / "action.memmap"
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    with pytest.raises(SystemExit) as caught:
        main(["data", "show", str(root), "--check", "--json"])
    printed = capsys.readouterr()
    assert caught.value.code == 2
    assert json.loads(printed.out)["damaged"] == [{"folder": str(root), "episodes": 1}]
    assert "1 of 6 episodes" in printed.err
    assert "nowhere" in fails(capsys, "data", "show", tmp_path / "nowhere")


def test_a_dataset_is_exported_and_imported(capsys, datasets, tmp_path):
    out = tmp_path / "lerobot"
    assert document(capsys, "data export", datasets[0].root, "--to", "lerobot", "--out", out)["format"] == "lerobot"
    shown = document(capsys, "data import", out, "--out", tmp_path / "back")
    assert (shown["steps"], shown["lacking"]) == (datasets[0].num_steps, [])
    before, after = (lw.LanguageWorldExperienceReplay(root)[:] for root in (datasets[0].root, tmp_path / "back"))
    assert torch.equal(before["action"], after["action"])
    assert "lerobot" in fails(capsys, "data", "export", datasets[0].root, "--to", "lerobto", "--out", tmp_path / "x")


def test_collect_by_experts_and_by_a_policy(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(lw, "collect_demonstrations", partial(lw.collect_demonstrations, max_steps=100))
    args = ("reach", "--episodes", 2, "--out", tmp_path / "demos", "--noise", 0, 0.1)
    shown = document(capsys, "collect", *args)
    assert (shown["tasks"], shown["steps"]) == ([{"task": "reach", "success": 1.0, "episodes_run": 2}], 200)
    config = lw.LanguageWorldExperienceReplay(tmp_path / "demos").demonstrations.config
    assert (config.tasks, config.episodes_per_task, config.noise_scale) == (("reach",), 2, (0.0, 0.1))
    assert "200 steps in" in run(capsys, "collect", *args), "nothing is left to do"
    assert "another configuration" in fails(capsys, "collect", "push", *args[1:])
    torch.manual_seed(0)
    policy = tmp_path / "tiny.safetensors"
    lw.save_actor(lw.PlanConditionedActor(lw.load_plans("MT10")), policy)
    for name, more in (("tiny", ()), ("mine", ("--behaviour", "mine"))):
        out = ("--policy", policy, "--episodes", 1, "--out", tmp_path / name)
        run(capsys, "collect", "reach", *out, *more)
        assert lw.LanguageWorldExperienceReplay(tmp_path / name, label="executed").behaviours == (name,)
    assert "raondm" in fails(capsys, "collect", "reach", "--out", tmp_path / "x", "--policy", "raondm")
    assert not (tmp_path / "x").exists()
