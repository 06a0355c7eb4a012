"""Packages: the source distribution, the wheel with its data, versions of dependencies, and types."""

import itertools
import json
import re
import shutil
import subprocess
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
from commands import python_process

import lw_torchrl

ROOT = Path(__file__).parent.parent
BUILD = """
import sys
from setuptools import build_meta
folder = sys.argv[1]  # setuptools writes its own arguments into sys.argv
build_meta.build_sdist(folder)
build_meta.build_wheel(folder)
build_meta.build_editable(folder + "/editable")
"""


@pytest.fixture(scope="module")
def kept() -> list[str]:
    """The files of the repository."""
    if not (ROOT / ".git").exists() or shutil.which("git") is None:
        pytest.skip("not a clone")
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return [name for name in listed.split("\0") if name and (ROOT / name).is_file()]


@pytest.fixture(scope="module")
def built(kept, tmp_path_factory) -> tuple[set[str], set[str], Path]:
    """The files in the source distribution and in the wheel of a clean clone, and the wheel."""
    pytest.importorskip("setuptools", minversion="77")
    clone, dist = tmp_path_factory.mktemp("clone"), tmp_path_factory.mktemp("dist")
    for name in kept:
        (clone / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, clone / name)
    (dist / "editable").mkdir()
    done = python_process("-c", BUILD, dist, cwd=clone, PYTHONPATH="")
    assert done.returncode == 0, done.stderr[-2000:]
    sdist, wheel = sorted(dist.glob("lw_torchrl-*"), key=lambda path: path.suffix)
    (editable,) = (dist / "editable").glob("*.whl")
    with zipfile.ZipFile(editable) as archive:
        (path,) = (name for name in archive.namelist() if name.endswith(".pth"))
        assert archive.read(path).decode().strip() == str(clone), "type checkers follow a path, and no import hook"
    assert sdist.name == f"lw_torchrl-{lw_torchrl.__version__}.tar.gz"
    with tarfile.open(sdist) as archive:
        sources = {member.name.split("/", 1)[1] for member in archive if member.isfile()}
    with zipfile.ZipFile(wheel) as archive:
        return sources, set(archive.namelist()), wheel


def test_distributions_have_the_package_and_its_data(kept, built):
    assert [name for name in kept if name not in built[0]] == []
    package = [name for name in kept if name.startswith("lw_torchrl/")]
    assert [name for name in package if name not in built[1]] == []
    assert "lw_torchrl/py.typed" in built[1]
    assert not [name for name in built[1] if name.split("/")[0] in ("tests", "benchmarks", "docs")]


@pytest.mark.slow
def test_wheel_works_outside_the_checkout(built, tmp_path):
    place, elsewhere = tmp_path / "installed", tmp_path / "elsewhere"
    elsewhere.mkdir()
    with zipfile.ZipFile(built[2]) as archive:
        archive.extractall(place)

    def ran(*words: str) -> str:
        done = python_process(*words, cwd=elsewhere, PYTHONPATH=str(place))
        assert done.returncode == 0, done.stderr[-2000:]
        return done.stdout

    assert ran("-c", "import lw_torchrl; print(lw_torchrl.__file__)").startswith(str(place))
    ran("-m", "lw_torchrl", "demo", "--quick")
    results = json.loads((elsewhere / "runs" / "demo-quick" / "results.json").read_text("utf-8"))
    assert results["config"]["tasks"] == ["drawer-open", "window-open"]
    assert (elsewhere / "runs" / "demo-quick" / "rollout.rrd").is_file()


def test_every_dependency_has_a_tested_version():
    stated = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    extras = stated["optional-dependencies"]
    needed = [*stated["dependencies"], *(line for name in ("text", "ray", "docs", "dev") for line in extras[name])]
    pinned = re.findall(r"^(\S+)==", (ROOT / "constraints.txt").read_text("utf-8"), re.MULTILINE)
    required, tested = ({re.split(r"[>\[]", line)[0].lower().replace("_", "-") for line in x} for x in (needed, pinned))
    assert sorted(required - tested - {"lw-torchrl"}) == []


def extras(text: str) -> set[str]:
    """Return the extras that a text tells the reader to install."""
    return set(filter(None, itertools.chain(*re.findall(r"lw_torchrl\[([a-z,-]+)\]|extra `?\[([a-z]+)\]", text))))


def test_extras_have_the_same_names_in_errors_and_pages():
    stated = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]
    page = (ROOT / "docs" / "install.md").read_text("utf-8")
    listed = re.findall(r"^\| `([a-z]+)` \|", page, re.MULTILINE)
    assert sorted(listed) == sorted(set(stated) - {"dev"})
    paths = [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *(ROOT / "lw_torchrl").rglob("*.py")]
    named = {path: extras(path.read_text("utf-8")) for path in paths}
    assert {"fetch", "llm", "text"} <= {name for path, names in named.items() if path.suffix == ".py" for name in names}
    assert {path.name: sorted(names - set(stated)) for path, names in named.items() if names - set(stated)} == {}


@pytest.mark.slow
def test_mypy_finds_mistakes_outside_the_checkout(tmp_path):
    """mypy reads the installed package. Overrides with other names of arguments, as in the docs, are not mistakes."""
    lines = Path(shutil.copy(Path(__file__).with_name("planted_errors.py"), tmp_path)).read_text("utf-8").splitlines()
    command = ("-m", "mypy", "--strict", "--config-file=", "--no-error-summary", "planted_errors.py")
    done = python_process(*command, cwd=tmp_path, MYPYPATH="")
    found = re.findall(r"^planted_errors\.py:(\d+): error: .*\[([a-z-]+)\]$", done.stdout, re.MULTILINE)
    planted = [number for number, line in enumerate(lines, 1) if line.endswith("# planted")]
    assert [int(line) for line, _ in found] == planted, done.stdout
    kinds = [kind for _, kind in found]
    assert kinds == ["attr-defined", "arg-type", "attr-defined", "override", "assignment", "assignment"]
