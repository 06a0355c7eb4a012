"""``lw-torchrl reproduce``: units one by one, then a summary, a table and a figure beside the published curves."""

import json
from dataclasses import replace
from types import MappingProxyType

import pytest
from commands import fails, run

import lw_torchrl as lw
from lw_torchrl.trainers import experiments
from lw_torchrl.trainers.experiments import PRESETS, DataSetting


@pytest.fixture
def tiny(monkeypatch):
    """Experiments of one demonstration and twenty steps."""
    small = replace(
        PRESETS["strong"],
        actor={"width": 16, "depth": 1},
        training=lw.BehavioralCloningConfig(steps=20, batch_size=20),
    )
    monkeypatch.setattr(experiments, "PRESETS", MappingProxyType({**PRESETS, "strong": small}))
    monkeypatch.setattr(experiments, "SETTINGS", MappingProxyType({"few-shot": DataSetting("few-shot", "reach", 1)}))


def test_units_and_their_summary(capsys, tmp_path, tiny):
    arguments = (
        "reproduce",
        "few-shot",
        "--seeds",
        0,
        1,
        "--methods",
        "pcbc",
        "dc",
        "--episodes",
        1,
        "--out",
        tmp_path,
    )
    out = run(capsys, *arguments, "--unit", "few-shot/strong/dc/seed1")
    assert "[1/1] few-shot/strong/dc/seed1: mean success 0." in out
    assert not (tmp_path / "few-shot" / "strong" / "pcbc").exists()
    first = (tmp_path / "few-shot" / "strong" / "dc" / "seed1" / "results.json").read_text()

    out = run(capsys, *arguments)
    assert "[4/4] few-shot/strong/dc/seed1" in out
    assert "about 0 min left" in out
    assert "few-shot, pcbc: mean 0." in out
    assert "2 seeds" in out
    assert "PCBC published, last" in out
    folder = tmp_path / "few-shot" / "strong"
    summary = json.loads((folder / "summary.json").read_text())
    assert list(summary) == ["pcbc", "dc"]
    assert list(summary["dc"]["tasks"]) == list(lw.MT50)
    assert (folder / "tasks.png").read_bytes().startswith(b"\x89PNG")
    assert (folder / "dc" / "seed1" / "results.json").read_text() == first


def test_an_unknown_unit_is_named(capsys, tmp_path, tiny):
    message = fails(
        capsys, "reproduce", "few-shot", "--seeds", 0, "--unit", "few-shot/strong/pbc/seed0", "--out", tmp_path
    )
    assert message is None or "did you mean" in message
