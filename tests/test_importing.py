"""Importing loads nothing heavy; an error names a missing library."""

import ast
import pkgutil
import re
import sys
from importlib.abc import MetaPathFinder
from pathlib import Path

import pytest

import lw_torchrl
from lw_torchrl.suites.metaworld.environments import import_metaworld


class WithoutOpenGL(MetaPathFinder):
    """Fails as PyOpenGL does if its library is missing."""

    def find_spec(self, fullname, path, target=None):
        if fullname == "metaworld":
            raise AttributeError("'NoneType' object has no attribute 'glGetError'")


@pytest.mark.parametrize(("backend", "library"), [("osmesa", "libosmesa6"), ("EGL", "libegl1"), ("", "")])
def test_error_names_a_missing_rendering_library(monkeypatch, backend, library):
    monkeypatch.setenv("MUJOCO_GL", backend)
    monkeypatch.delitem(sys.modules, "metaworld", raising=False)
    monkeypatch.setattr(sys, "meta_path", [WithoutOpenGL(), *sys.meta_path])
    message = f"MUJOCO_GL is '{backend.lower()}'.*{library}.*unset MUJOCO_GL" if backend else "glGetError"
    with pytest.raises(ImportError if backend else AttributeError, match=message):
        import_metaworld()


EVERY_ROOM = """
import pkgutil, sys
from importlib import import_module
import lw_torchrl
class Failing:
    def find_spec(self, fullname, path, target=None):
        if fullname == "torchrl":
            raise AttributeError("'NoneType' object has no attribute 'glGetError'")
sys.meta_path.insert(0, Failing())
for module in pkgutil.iter_modules(lw_torchrl.__path__):
    if module.ispkg and module.name[0] != "_":
        try:
            import_module(f"lw_torchrl.{module.name}")
            print(module.name, "loads no TorchRL")
        except ImportError as error:
            print(module.name, error)
"""


def test_error_of_every_room_names_the_missing_library(python):
    process = python(EVERY_ROOM, MUJOCO_GL="osmesa")
    assert process.returncode == 0, process.stderr
    result = dict(line.split(" ", 1) for line in process.stdout.splitlines())
    light = {"cli", "language", "planners", "suites"}
    assert {room for room, text in result.items() if text == "loads no TorchRL"} == light
    assert all("libosmesa6" in text for room, text in result.items() if room not in light)
    assert len(result) >= 10


LOADED = """
import sys
import torchrl.envs
before = {name.split(".")[0] for name in sys.modules}
import lw_torchrl
for name in lw_torchrl.__all__:
    getattr(lw_torchrl, name)
print(*sorted({name.split(".")[0] for name in sys.modules} - before - {*sys.stdlib_module_names}))
"""


def test_all_names_load_few_packages_that_torchrl_does_not(python):
    process = python(LOADED)
    assert process.returncode == 0, process.stderr
    loaded = {name for name in process.stdout.split() if not name.startswith("_cython_")}  # of rapidfuzz
    assert {"lw_torchrl", "safetensors"} <= loaded
    assert loaded <= {"beartype", "farama_notifications", "gymnasium", "lw_torchrl", "rapidfuzz", "safetensors"}


def test_package_loads_no_torch_and_plans_load_no_torchrl(python):
    program = "import sys, lw_torchrl as lw; print('torch' in sys.modules); lw.load_plans('MT10'); "
    process = python(program + "print([name for name in ('torchrl', 'mujoco') if name in sys.modules])")
    assert process.stdout.split() == ["False", "[]"], process.stderr


def test_stub_lists_the_names_of_the_package():
    stub = ast.parse(Path(lw_torchrl.__file__).with_suffix(".pyi").read_text("utf-8"))
    lines = [node for node in stub.body if isinstance(node, ast.ImportFrom)]
    stated = {alias.asname: line.module for line in lines for alias in line.names}
    rooms = [name for name, module in stated.items() if module == "lw_torchrl"]
    assert rooms == lw_torchrl._ROOMS
    assert sorted({*stated} - {*rooms}) == lw_torchrl.__all__


def test_top_level_is_small_and_docs_show_each_of_its_names():
    assert len(lw_torchrl.__all__) <= 60
    root = Path(__file__).parent.parent
    pages = [root / "README.md", *root.glob("docs/**/*.md")]
    shown = [block for page in pages for block in re.findall(r"```py.*?```", page.read_text("utf-8"), re.DOTALL)]
    shown += [file.read_text("utf-8") for file in root.glob("examples/*.py")]
    used = set(re.findall(r"\blw\.(\w+)", "\n".join(shown)))
    assert not {*lw_torchrl.__all__} - used


def test_names_and_rooms_are_attributes():
    assert set(lw_torchrl.__all__) <= set(dir(lw_torchrl))
    assert lw_torchrl.evaluation.evaluate is lw_torchrl.evaluate
    with pytest.raises(AttributeError, match="no attribute 'load_plan'"):
        lw_torchrl.load_plan  # noqa: B018
    with pytest.raises(AttributeError, match=r"'load_policy'.*load_actor"):  # it lists names with the same verb
        lw_torchrl.load_policy  # noqa: B018
    rooms = {module.name for module in pkgutil.iter_modules(lw_torchrl.__path__) if module.ispkg}
    assert {*lw_torchrl._ROOMS, "cli", "_util"} == rooms
