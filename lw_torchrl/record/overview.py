"""The overview of a recording: a row for each episode, failures first, and the causes counted."""

from collections import Counter
from collections.abc import Iterable
from typing import Any

OVERVIEW = "overview"
"""The entity that it lies under, and its tab's name."""


def ordered(rows: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows with failures first, by task and episode."""
    return sorted(rows, key=lambda row: (row["ended"] != "failed", row["task"], row["episode"] or 0))


def table(rows: Iterable[dict[str, Any]]) -> str:
    """The rows as Markdown, below the counts of failures and causes; an episode is named as its tab is."""
    rows = ordered(rows)
    ended = Counter(row["ended"] for row in rows)
    causes = Counter(row["cause"] for row in rows if row["cause"])
    known = ended["failed"] + ended["success"]
    counts = [f"{ended['failed']} of {known} episodes failed" if known else f"{len(rows)} episodes"]
    counts += [f"{cause} {number}" for cause, number in causes.most_common()]
    lines = [f"## {' · '.join(counts)}", "", "| | episode | who | cause | ended at t | seconds |", "|-|-|-|-|-|-|"]
    for row in rows:
        mark = {"success": "✓", "failed": "✗"}.get(row["ended"], "·")
        cells = [mark, row["title"], row["policy"] or "", row["cause"] or "", row["at"], f"{row['seconds']:.2f}"]
        lines.append("| " + " | ".join(str(cell).replace("|", "/") for cell in cells) + " |")
    return "\n".join(lines) + "\n"
