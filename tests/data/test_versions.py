"""Versions of the simulator: recorded from the start, and compared when a dataset is resumed."""

from __future__ import annotations

import importlib.metadata

import pytest
from collecting import collect, interrupt_after

from lw_torchrl._util.reproducibility import SIMULATORS, package_versions, version_changes
from lw_torchrl.data import DatasetError


def test_version_changes():
    now = package_versions()
    assert {*SIMULATORS, "torch", "numpy", "lw_torchrl"} <= now.keys()
    assert version_changes(now, now) == []
    assert version_changes({**now, "mujoco": "3.2.0"}, now) == [f"mujoco 3.2.0, now {now['mujoco']}"]


def test_episodes_of_two_simulators_are_not_mixed(tmp_path, monkeypatch):
    root = tmp_path / "demos"
    with pytest.MonkeyPatch.context() as patch:
        interrupt_after(patch, 2)
        with pytest.raises(KeyboardInterrupt):
            collect(root, num_envs=2)
    recorded, real = package_versions(), importlib.metadata.version
    with monkeypatch.context() as patch:
        patch.setattr(
            "lw_torchrl._util.reproducibility.version", lambda name: "9.9.9" if name == "mujoco" else real(name)
        )
        with pytest.raises(DatasetError, match=rf"another simulator \(mujoco {recorded['mujoco']}, now 9.9.9\)"):
            collect(root)
    assert collect(root).versions == recorded
