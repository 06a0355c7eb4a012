"""The figures of README and docs: they are drawn, and their numbers are those that the pages print."""

import json
from pathlib import Path

import pytest

from benchmarks import docs_figures

ROOT = Path(__file__).parents[2]
NUMBERS = json.loads(docs_figures.NUMBERS.read_text("utf-8"))


def rates(value):
    """Yield the (mean, low, high) lists in nested lists and objects."""
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else []
    if isinstance(value, list) and len(value) == 3 and all(isinstance(number, float) for number in value):
        yield value
    else:
        for each in inner:
            yield from rates(each)


def test_figures_are_drawn_and_pictures_of_docs_have_their_names(tmp_path):
    docs_figures.main(docs_figures.Arguments(tmp_path))
    assert {path.name for path in tmp_path.iterdir()} == set(docs_figures.FIGURES)
    assert all((ROOT / "docs" / name).is_file() for name in docs_figures.FIGURES)


@pytest.mark.parametrize("key", [key for key, _ in docs_figures.FIGURES.values()])
def test_numbers_of_figures_are_on_a_page(key):
    pages = "\n".join(path.read_text("utf-8") for top in ("docs", "benchmarks") for path in (ROOT / top).rglob("*.md"))
    assert not [rate for rate in rates(NUMBERS[key]) if "{:.3f} [{:.3f}, {:.3f}]".format(*rate) not in pages]
