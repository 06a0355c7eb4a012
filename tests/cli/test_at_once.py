"""Two processes told to write to one place: one does, and the other is told why it does not."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

import lw_torchrl as lw
from lw_torchrl.training.checkpoint import read_description


@pytest.mark.slow
def test_of_two_trainings_into_one_file_one_is_refused(tmp_path):
    """Both ended well, and one policy was lost."""
    lw.collect_demonstrations("reach", episodes_per_task=1, root=tmp_path / "demos", max_steps=40, progress=False)
    out = tmp_path / "policy.safetensors"
    options = ["--width", "8", "--depth", "1", "--batch-size", "20", "--steps", "400"]
    command = [sys.executable, "-m", "lw_torchrl", "train", str(tmp_path / "demos"), "--out", str(out), *options]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    both = [
        subprocess.Popen([*command, "--seed", str(seed)], env=environment, stderr=subprocess.PIPE, text=True)
        for seed in (0, 1)
    ]
    errors = [one.communicate(timeout=200)[1] for one in both]
    assert sorted(one.returncode for one in both) == [0, 2], errors
    (winner,) = (seed for seed, one in enumerate(both) if one.returncode == 0)
    assert read_description(out)["training"]["seed"] == winner
    said = ("another training is writing to", "was written by another training", "is of another configuration")
    assert any(one in errors[1 - winner] for one in said), errors
    assert [path.name for path in tmp_path.iterdir() if path.name[0] == "."] == []


def test_a_demo_is_refused_where_another_one_is_at_work(tmp_path, holding, capsys):
    from lw_torchrl.cli.main import main

    holding(tmp_path / "demo", folder=True)
    with pytest.raises(SystemExit):
        main(["demo", "--quick", "--out", str(tmp_path / "demo")])
    assert f"another process is writing to '{tmp_path / 'demo'}'; let it finish" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "demo").iterdir()] == [".lock"]
