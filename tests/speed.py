"""Which cases of a test the fast suite runs."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def first_fast(values: Iterable[Any], fast: int = 1) -> list[Any]:
    """The values of a parametrisation: the first are fast, the others are slow tests."""
    return [one if n < fast else pytest.param(one, marks=pytest.mark.slow) for n, one in enumerate(values)]
