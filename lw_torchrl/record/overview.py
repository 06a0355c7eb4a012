"""The overview of a recording: a row for each episode, failures first, and the causes counted."""

from collections import Counter
from collections.abc import Iterable
from typing import Any

OVERVIEW = "overview"
"""The entity that it lies under, and its tab's name."""


def place(row: dict[str, Any]) -> tuple[Any, ...]:
    """What rows, and tabs, are sorted by: failures first, then by task and episode."""
    return row["ended"] != "failed", row["task"], row["episode"] or 0


def table(rows: Iterable[dict[str, Any]]) -> str:
    """The rows as Markdown, below the counts of failures and causes; an episode is named as its tab is."""
    rows = sorted(rows, key=place)
    ended = Counter(row["ended"] for row in rows)
    causes = Counter(row["cause"] for row in rows if row["cause"])
    known = ended["failed"] + ended["success"]
    counts = [f"{ended['failed']} of {known} episodes failed" if known else f"{len(rows)} episodes"]
    counts += [f"{cause} {number}" for cause, number in causes.most_common()]
    columns = {"": "mark", "episode": "title", "who": "policy", "cause": "cause", "ended": "when"}
    who = {row["policy"] for row in rows}
    if len(who) == 1:  # told once, for a table that is not too wide
        del columns["who"]
    if not causes:
        del columns["cause"]
    acted = [f"By {who.pop()}.", ""] if len(who) == 1 and None not in who else []
    lines = [f"#### {' · '.join(counts)}", "", *acted, f"| {' | '.join(columns)} |", "|-" * len(columns) + "|"]
    for row in rows:
        mark = {"success": "✓", "failed": "✗"}.get(row["ended"], "·")
        said = row | {"mark": mark, "when": f"t = {row['at']} ({row['seconds']:.2f} s)"}
        cells = [str(said[key] or "").replace("|", "/") for key in columns.values()]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"
