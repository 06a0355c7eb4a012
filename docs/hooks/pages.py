"""Add the pages of the site that are not in docs/: README, changelog, laboratory, examples, linked code, reference."""

from __future__ import annotations

import ast
import json
import posixpath
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

sys.path.insert(0, str(Path(__file__).parent))
import reference

ROOT = Path(__file__).parents[2]
TOUR = "examples/tour.ipynb"
PAGES = {"README.md": "index.md", "CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md", TOUR: "tour.md"}
for results_page in (ROOT / "benchmarks" / "results").glob("*.md"):
    name = "index" if results_page.stem == "README" else results_page.stem
    PAGES[f"benchmarks/results/{results_page.name}"] = f"results/{name}.md"
LANGUAGES = {".py": "python", ".toml": "toml", ".cff": "yaml"}
LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\[\]]*\])*)\]\(([^)\s#]*)(#[^)\s]*)?\)")
CODE = re.compile(r"^ *(?P<fence>`{3,}).*?^ *(?P=fence)", re.MULTILINE | re.DOTALL)


def on_files(files: Files, config: Any) -> Files:
    """Add the pages."""
    made = {page: (ROOT / name).read_text("utf-8") for name, page in PAGES.items()}
    made["tour.md"] = notebook(made["tour.md"])
    examples = sorted((ROOT / "examples").rglob("*.py"))
    made["examples.md"] = example_list(examples)
    texts = {f"docs/{file.src_uri}": file.content_string for file in files.documentation_pages()}
    texts |= {name: made[page] for name, page in PAGES.items()}
    linked = {target for name, text in texts.items() for target in targets(name, text)}
    for path in {*examples, *(ROOT / name for name in linked if not name.startswith("docs/") and name not in PAGES)}:
        if path.is_file():
            name = path.relative_to(ROOT).as_posix()
            code = f"````{LANGUAGES.get(path.suffix, 'text')}\n{path.read_text('utf-8')}````"
            title = path.name.replace("_", r"\_")
            made[place(name)] = f"# {title}\n\n`{name}`\n\n{code}\n"
    for page, text in {**made, **reference.pages()}.items():
        files.append(File.generated(config, page, content=text))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Turn links for GitHub into links of the site; a link to a folder becomes plain text."""
    here = page.file.src_uri
    if here.startswith(("api/", "code/", "results/")):
        page.meta["search"] = {"boost": 0.3}  # a search finds the how-to pages first
    name = next((name for name, its_page in PAGES.items() if its_page == here), f"docs/{here}")

    def moved(match: re.Match[str]) -> str:
        mark, text, target, anchor = match.groups(default="")
        full = resolved(name, target)
        if not target or not (ROOT / full).exists():
            return match[0]
        if not full.startswith("docs/") and files.get_file_from_path(place(full)) is None:
            return text
        if text.endswith(".md") and (target_page := files.get_file_from_path(place(full))) is not None:
            text = target_page.content_string.partition("\n")[0].removeprefix("# ")  # not the file name
        return f"{mark}[{text}]({posixpath.relpath(place(full), posixpath.dirname(here) or '.')}{anchor})"

    return outside_code(markdown, lambda text: LINK.sub(moved, text))


def on_page_content(html: str, page: Any, config: Any, files: Files) -> str:
    """Link each picture to its file: on a narrow screen, a recording is legible only at full size."""
    return re.sub(r'<img [^>]*src="([^":]+)"[^>]*>', r'<a href="\1">\g<0></a>', html)


def place(name: str) -> str:
    """Return the page of a file of the repository."""
    return name.removeprefix("docs/") if name.startswith("docs/") else PAGES.get(name, f"code/{name}.md")


def resolved(name: str, target: str) -> str:
    return posixpath.normpath(posixpath.join(posixpath.dirname(name), target))


def targets(name: str, text: str) -> list[str]:
    """Return the files of the repository that a page links to."""
    return [resolved(name, match[3]) for match in LINK.finditer(CODE.sub("", text)) if match[3] and ":" not in match[3]]


def outside_code(text: str, change: Callable[[str], str]) -> str:
    parts, end = [], 0
    for match in CODE.finditer(text):
        parts += [change(text[end : match.start()]), match[0]]
        end = match.end()
    return "".join([*parts, change(text[end:])])


def example_list(paths: list[Path]) -> str:
    rows = ["# Examples", "", "Each is one page, and a test runs it.", "", "| file | shows |", "|---|---|"]
    for path in paths:
        about = (ast.get_docstring(ast.parse(path.read_text("utf-8"))) or "").split("\n\n")[0].replace("\n", " ")
        name = path.relative_to(ROOT / "examples").as_posix()
        rows.append(f"| [{name}](../examples/{name}) | {about} |")
    return "\n".join(rows)


def notebook(text: str) -> str:
    """Return a notebook's cells and their outputs as Markdown."""
    parts = []
    for cell in json.loads(text)["cells"]:
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            if "image/png" in data:
                picture = "".join(data["image/png"]).replace("\n", "")
                parts.append(f'<img alt="Figure of the cell above" src="data:image/png;base64,{picture}">')
            elif printed := "".join(output.get("text", data.get("text/plain", ""))).rstrip():
                parts.append(f"``` {{.text .wrap}}\n{printed}\n```")
    return "\n\n".join(parts) + "\n"
