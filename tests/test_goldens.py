"""What a refactoring must not change: the checks of benchmarks.goldens."""

from pathlib import Path

import pytest
from commands import python_process

from benchmarks.goldens import CHECKS


@pytest.mark.slow
@pytest.mark.parametrize("name", CHECKS)
def test_golden(name):
    """In a process of its own: other tests may have registered relations, which add queries."""
    root = Path(__file__).parent.parent
    done = python_process("-m", "benchmarks.goldens", name, cwd=root, timeout=None, OMP_NUM_THREADS="1")
    assert done.returncode == 0, done.stdout + done.stderr
