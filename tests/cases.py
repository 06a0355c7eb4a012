"""The cases of parametrized tests, in TOML files beside the tests."""

import tomllib
from pathlib import Path
from typing import Any


def read_cases(path: str) -> dict[str, Any]:
    """Return the tables of a file in the folder of tests, by name."""
    return tomllib.loads((Path(__file__).parent / path).read_text("utf-8"))
