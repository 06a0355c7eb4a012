"""What is handed out: a source distribution that can be tested, a wheel with all its data, and one version."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

import lw_torchrl

ROOT = Path(__file__).parent.parent
BUILD = """
import sys
from setuptools import build_meta
folder = sys.argv[1]  # setuptools writes its own arguments into sys.argv
build_meta.build_sdist(folder)
build_meta.build_wheel(folder)
"""


@pytest.fixture(scope="module")
def kept() -> list[str]:
    """The files of the repository."""
    if not (ROOT / ".git").exists() or shutil.which("git") is None:
        pytest.skip("not a clone")
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return [name for name in listed.split("\0") if name and (ROOT / name).is_file()]


@pytest.fixture(scope="module")
def built(kept, tmp_path_factory) -> tuple[set[str], set[str]]:
    """The files in the source distribution and in the wheel of a clean clone."""
    pytest.importorskip("setuptools", minversion="77")
    clone, dist = tmp_path_factory.mktemp("clone"), tmp_path_factory.mktemp("dist")
    for name in kept:
        (clone / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, clone / name)
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [sys.executable, "-c", BUILD, str(dist)], cwd=clone, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-2000:]
    sdist, wheel = sorted(dist.iterdir(), key=lambda path: path.suffix)
    assert sdist.name == f"lw_torchrl-{lw_torchrl.__version__}.tar.gz"
    with tarfile.open(sdist) as archive:
        sources = {member.name.split("/", 1)[1] for member in archive if member.isfile()}
    with zipfile.ZipFile(wheel) as archive:
        return sources, set(archive.namelist())


def test_the_source_distribution_is_the_repository(kept, built):
    assert [name for name in kept if name not in built[0]] == []


def test_the_wheel_is_the_package_with_its_data(kept, built):
    package = [name for name in kept if name.startswith("lw_torchrl/")]
    assert [name for name in package if name not in built[1]] == []
    assert "lw_torchrl/py.typed" in built[1]
    assert not [name for name in built[1] if name.split("/")[0] in ("tests", "benchmarks", "docs")]


def test_every_dependency_has_a_tested_version():
    stated = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    extras = stated["optional-dependencies"]
    needed = [*stated["dependencies"], *(one for name in ("text", "ray", "dev") for one in extras[name])]
    pinned = {
        line.split("==")[0].lower().replace("_", "-")
        for line in (ROOT / "constraints.txt").read_text("utf-8").splitlines()
        if "==" in line
    }
    names = {one.split(">")[0].split("[")[0].lower().replace("_", "-") for one in needed} - {"lw-torchrl"}
    assert sorted(names - pinned) == []
