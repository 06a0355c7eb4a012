"""What a refactoring must not change: the checks of benchmarks.goldens."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.goldens import CHECKS


@pytest.mark.slow
@pytest.mark.parametrize("name", CHECKS)
def test_golden(name):
    """In a process of its own: other tests may have registered relations, which add queries."""
    command = [sys.executable, "-m", "benchmarks.goldens", name]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=Path(__file__).parent.parent, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
