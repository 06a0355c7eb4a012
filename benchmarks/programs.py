"""python -m benchmarks.programs [FILE ...]: measure the fraction of a program's actions that decode_plan keeps.

A file is JSON: {style: {task: text}}, or {style: {task: [{"text": ..., "actions": [...]}, ...]}} with a list of actions
by the writer of the text. Without such a list, this script finds the actions itself, not with the tested parsers: calls
of ``robot`` in Python, texts that are not conditions or names in JSON, and imperatives in prose. An action counts as
kept if a step of the plan has its words, and a lost action counts as named if a note quotes its words.

data/blind_programs.json holds 120 programs whose writers knew only the development tasks and the query language. The
first measurements kept 0.602, 0.588 and 0.549 of the actions. The programs have been development data since then.
"""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import tyro

import lw_torchrl as lw

BLIND = Path(__file__).parent / "data" / "blind_programs.json"
_NO_ACTION = {
    "if", "when", "while", "until", "condition", "check", "name", "type", "next", "to", "initial", "start",
    "all", "any", "and", "or", "not",
}  # fmt: skip
_VERBS = "close|move|lower|lift|raise|carry(?! on)|push|pull|slide|sweep|stop|keep moving|drag|turn|open(?! *,)"
_IMPERATIVE = re.compile(
    rf"(?:^|[.:;] |, (?:first )?|\band |\bthen )((?:{_VERBS})\b[^.,;:]*?)(?=[.,;:]| and (?:{_VERBS}|go)\b|$)",
    re.IGNORECASE | re.MULTILINE,
)


def actions_in(text: str) -> list[str]:
    """Return the words of each action in a text."""
    if text.lstrip().startswith("{"):
        return [*_json_actions(json.loads(text))]
    if "def " in text:
        calls = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call)]
        return [_words(ast.unparse(call)[6:]) for call in calls if ast.unparse(call.func).startswith("robot.")]
    return [
        _words(match[1]) for match in _IMPERATIVE.finditer(re.sub(r"^\d+\. (?:Otherwise, )?", "", text, flags=re.M))
    ]


def _json_actions(value: Any, key: str = "do", is_condition: bool = False) -> Iterator[str]:
    if isinstance(value, dict) and "verb" in value:
        yield _words(f"{value['verb']} {value['object']}")
    elif isinstance(value, dict):
        for name, each in value.items():
            tested = is_condition or (
                value.get("type") in ("condition", "selector", "sequence") and isinstance(each, str)
            )
            yield from _json_actions(each, name, tested)
    elif isinstance(value, list):
        for each in value:
            yield from _json_actions(each, key, is_condition)
    elif key not in _NO_ACTION and not is_condition and isinstance(value, str):
        yield _words(value)


def _words(text: str) -> str:
    text = re.sub(r"\{\w+\}", " ", text.replace("_(", "(").replace("_", " "))
    return " ".join(word for word in re.findall(r"[a-z']+", text.lower()) if word not in ("the", "f", "'"))


def _overlap(action: str, other: str) -> bool:
    """Return whether two texts begin with the same word and share all but one of the shorter text's words.

    "it" and "there" are ignored, and "keep pushing" counts as "push".
    """
    first, second = (re.sub(r"['f]", "", _words(text)) for text in (action, other))
    first, second = (re.sub(r"^keep (\w+)ing\b", r"\1", text).split() for text in (first, second))
    first, second = ([word for word in words if word not in ("it", "there")] for words in (first, second))
    shared = len({*first} & {*second})
    return first[:1] == second[:1] and shared >= min(len({*first}), len({*second})) - 1


def _texts(entry: Any) -> list[tuple[str, list[str]]]:
    """Return the (text, actions) pairs of a task."""
    if isinstance(entry, str):
        return [(entry, actions_in(entry))]
    return [(each["text"], [_words(action) for action in each["actions"]]) for each in entry]


def main(files: tyro.conf.Positional[tuple[Path, ...]] = (BLIND,), show: bool = False) -> None:
    for file in files:
        for style, programs in json.loads(file.read_text("utf-8")).items():
            _measure(style, [(task, *pair) for task, entry in programs.items() for pair in _texts(entry)], show)


def _measure(style: str, programs: list[tuple[str, str, list[str]]], show: bool) -> None:
    total = kept = named = plans = 0
    for task, text, actions in programs:
        decoded = lw.decode_plan(text, task)
        left = [part for step in decoded.steps if not step.dropped for part in re.split(" and ", step.written_skill)]
        plans += decoded.plan is not None
        for action in actions:
            total += 1
            match = next((skill for skill in left if _overlap(action, skill)), None)
            if match is not None:
                left.remove(match)
                kept += 1
            else:
                is_named = any(
                    _overlap(action, words) for note in decoded.notes for words in re.findall(r"'([^']*)'", str(note))
                )
                named += is_named
                print(f"  {task}: lost {action!r}, {'named' if is_named else 'not named'} in the notes")
        if show:
            print(decoded.plan, *decoded.notes, sep="\n")
    print(
        f"{style}: {plans} of {len(programs)} plans, {kept} of {total} actions kept ({kept / total:.3f}), "
        f"{named} of {total - kept} lost ones named in the notes"
    )


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
