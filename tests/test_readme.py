"""README: short, with pictures that load fast, and a citation with the paper's identifier."""

import re
from pathlib import Path

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text("utf-8")


def test_readme_has_at_most_700_words():
    assert len(README.split()) <= 700


def test_pictures_of_the_readme_are_small():
    pictures = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", README)
    assert "docs/plan.gif" in pictures
    assert all((ROOT / picture).stat().st_size < 3_000_000 for picture in pictures)


def test_citation_names_the_paper():
    (identifier,) = re.findall(r"arXiv:([\d.]+)", (ROOT / "CITATION.cff").read_text("utf-8"))
    entry = (ROOT / "lw_torchrl" / "evaluation" / "data" / "citation.bib").read_text("utf-8")
    assert f"eprint = {{{identifier}}}" in entry
    assert f"```bibtex\n{entry}```" in README


def test_every_picture_of_docs_is_used():
    pages = [path.read_text("utf-8") for folder in ("docs", "benchmarks") for path in (ROOT / folder).rglob("*.md")]
    text = "".join([README, *pages])
    pictures = [path.name for path in (ROOT / "docs").iterdir() if path.suffix in (".png", ".gif", ".svg")]
    assert not [name for name in pictures if name not in text]
