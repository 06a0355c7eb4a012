"""What a refactoring must not change: the checks of benchmarks.goldens."""

from __future__ import annotations

import pytest

from benchmarks.goldens import CHECKS, Arguments


@pytest.mark.slow
@pytest.mark.parametrize("name", CHECKS)
def test_golden(name):
    differences = [said for said, same in CHECKS[name](Arguments()) if not same]
    assert not differences
