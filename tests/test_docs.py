"""Examples of docstrings and Python blocks of pages run; links lead somewhere; README is short and cites the paper."""

import doctest
import importlib
import inspect
import json
import pkgutil
import re
import warnings
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from commands import python_process
from pictures import why_no_pictures

import lw_torchrl

ROOT = Path(__file__).parent.parent
FAST_PAGES = {"README.md", "first-plan.md", "how-it-works.md", "reference.md"}
README = (ROOT / "README.md").read_text("utf-8")
RESULTS = ROOT / "benchmarks" / "results"
PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").glob("**/*.md")), *sorted(RESULTS.glob("*.md"))]
BLOCK = re.compile(
    r"(?P<skip><!--\s*no-run\s*-->\s*\n)?"
    r"^(?P<indent> *)```(?P<kind>python|py|pycon)[^\n]*\n(?P<code>.*?)^(?P=indent)```",
    re.MULTILINE | re.DOTALL,
)
MODULES = sorted(module.name for module in pkgutil.walk_packages(lw_torchrl.__path__, "lw_torchrl."))
# What a user searches for, and the page that must come first; "" is the first page.
SEARCHES = {"GPU": "scaling/", "wandb": "logging/", "cite": "", "custom network": "custom-networks/"}
SEARCHES["SLURM"] = SEARCHES["GPU"]


def blocks(page):
    """Yield (line, kind, code) of each block that runs."""
    text = page.read_text("utf-8")
    for match in BLOCK.finditer(text):
        if not match["skip"]:
            lines = [line.removeprefix(match["indent"]) for line in match["code"].splitlines(keepends=True)]
            yield text[: match.start("code")].count("\n"), match["kind"], "".join(lines)


def examples(name):
    module = importlib.import_module(name)
    return [test for test in doctest.DocTestFinder(exclude_empty=True).find(module) if test.examples]


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    """Run examples in an empty folder, without a warning of TorchRL's."""
    monkeypatch.chdir(tmp_path)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*target_actor_network_params.*")
        yield


@pytest.mark.parametrize("name", [name for name in MODULES if examples(name)])
def test_examples_of_docstrings_run(name):
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS)
    report = []
    for test in examples(name):
        if not test.name.endswith(".render") or not why_no_pictures():
            runner.run(test, out=report.append)
    assert runner.summarize(verbose=False).failed == 0, "".join(report)


def test_every_public_class_has_a_docstring():
    rooms = [importlib.import_module(f"lw_torchrl.{room}") for room in lw_torchrl._ROOMS]
    public = {name: getattr(room, name) for room in (lw_torchrl, *rooms) for name in getattr(room, "__all__", ())}
    classes = {name: one.__doc__ for name, one in public.items() if inspect.isclass(one)}
    assert len(classes) > 80
    # The docstring of a dataclass is its signature by default.
    assert not [name for name, docstring in classes.items() if not docstring or docstring.startswith(f"{name}(")]


def page_name(page):
    return page.relative_to(ROOT).as_posix()


WITH_CODE = [page for page in PAGES if any(blocks(page))]
SLOW = [pytest.param(page, marks=pytest.mark.slow) for page in WITH_CODE if page.name not in FAST_PAGES]


@pytest.mark.parametrize("page", [*(page for page in WITH_CODE if page.name in FAST_PAGES), *SLOW], ids=page_name)
def test_code_of_a_page_runs(page):
    namespace = {"__name__": "__main__"}
    for line, kind, code in blocks(page):
        if "PixelRenderTransform" in code and why_no_pictures():
            continue
        if kind == "pycon":
            test = doctest.DocTestParser().get_doctest(code, namespace, page.name, str(page), line)
            runner, report = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS), []
            runner.run(test, out=report.append, clear_globs=False)
            assert runner.summarize(verbose=False).failed == 0, "".join(report)
            namespace.update(test.globs)
        else:
            # The empty lines make tracebacks name the page's line.
            exec(compile("\n" * line + code, str(page), "exec"), namespace)


def anchors(page):
    """Return the anchors of a page's headings, as GitHub and the site make them."""
    text = re.sub(r"^ *```.*?^ *```", "", page.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_links_of_pages_lead_somewhere(page):
    text = re.sub(r"```.*?```", "", page.read_text("utf-8"), flags=re.DOTALL)
    for target, anchor in re.findall(r"\]\(([^)#\s]*)(?:#([^)\s]+))?\)", text):
        if "://" not in target and not target.startswith("mailto:"):
            path = page.parent / target if target else page
            assert path.exists(), target
            assert not anchor or path.suffix != ".md" or anchor in anchors(path), f"{target}#{anchor}"


def test_files_that_pages_name_exist():
    named = re.findall(r"`([a-z_/]+(?:\.py|\.toml|/))`", (ROOT / "docs" / "design.md").read_text("utf-8"))
    tops = [ROOT / name for name in ("lw_torchrl", "benchmarks", "examples", "tests", "docs")]
    paths = [path for top in tops for path in (top, *top.rglob("*"))]
    existing = [f"{path.as_posix()}/" if path.is_dir() else path.as_posix() for path in paths]
    assert len(named) > 50
    assert not [name for name in named if not any(path.endswith(f"/{name}") for path in existing)]


def test_every_page_is_in_the_site():
    navigation = (ROOT / "mkdocs.yml").read_text("utf-8").partition("\nnav:")[2]
    listed = re.findall(r"^ +- (?:.+: )?(\S+\.md)$", navigation, re.MULTILINE)
    lost = {page.name for page in (ROOT / "docs").glob("*.md")} - set(listed)
    assert not lost, f"add to the nav of mkdocs.yml: {', '.join(sorted(lost))}"


def test_readme_is_short_and_cites_the_paper():
    assert len(README.split()) <= 700
    pictures = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", README)
    assert "docs/plan.gif" in pictures
    assert all((ROOT / picture).stat().st_size < 3_000_000 for picture in pictures)
    (identifier,) = re.findall(r"arXiv:([\d.]+)", (ROOT / "CITATION.cff").read_text("utf-8"))
    entry = (ROOT / "lw_torchrl" / "evaluation" / "data" / "citation.bib").read_text("utf-8")
    assert f"eprint = {{{identifier}}}" in entry
    assert f"```bibtex\n{entry}```" in README


def test_every_picture_of_docs_is_used():
    pages = [path.read_text("utf-8") for folder in ("docs", "benchmarks") for path in (ROOT / folder).rglob("*.md")]
    text = "".join([README, *pages])
    pictures = [path.name for path in (ROOT / "docs").iterdir() if path.suffix in (".png", ".gif", ".svg")]
    assert not [name for name in pictures if name not in text]


class Page(HTMLParser):
    """The links and the anchors of a page of the site."""

    def __init__(self, path):
        super().__init__()
        self.links, self.names = set(), set()
        self.feed(path.read_text("utf-8"))

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.names |= {attrs[key] for key in ("id", "name") if attrs.get(key)}
        self.links |= {attrs[key] for key in ("href", "src") if attrs.get(key)}


@pytest.mark.slow
def test_site_is_built_without_warnings_and_its_links_lead_somewhere(tmp_path):
    pytest.importorskip("mkdocs")
    site = tmp_path / "site"
    command = ("-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", site)
    done = python_process(*command, cwd=ROOT, timeout=None, NO_MKDOCS_2_WARNING="1")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    pages = {path: Page(path) for path in site.rglob("*.html") if path.name != "404.html"}
    assert len(pages) > 50
    lost = []
    for path, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            target = target / "index.html" if target.is_dir() else target
            if not target.is_file() or (parts.fragment and unquote(parts.fragment) not in pages[target].names):
                lost.append(f"{path.relative_to(site)}: {link}")
    assert lost == []
    entries = json.loads((site / "search" / "search_index.json").read_text("utf-8"))["docs"]
    assert {words: found(words, entries) for words in SEARCHES} == SEARCHES


def found(words, entries):
    """Return the page of the search entry that has all words, most of them in its title and at the highest boost."""
    words = words.lower().split()
    hits = [entry for entry in entries if all(word in f"{entry['title']} {entry['text']}".lower() for word in words)]

    def score(entry):
        title, text = entry["title"].lower(), entry["text"].lower()
        return entry.get("boost", 1) * sum(10 * (word in title) + text.count(word) for word in words)

    return max(hits, key=score)["location"].partition("#")[0]


def test_code_blocks_are_found_numbered_and_skipped(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "words\n```python\na = 1\n```\n<!-- no-run -->\n```python\nb = 2\n```\n- item\n\n  ```python\n  c = 3\n  ```\n"
        "```sh\nd\n```\n"
    )
    assert list(blocks(page)) == [(2, "python", "a = 1\n"), (11, "python", "c = 3\n")]
