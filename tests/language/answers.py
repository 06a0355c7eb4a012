"""The answers of answers.toml, as models write them, and what is to be read from each."""

import tomllib
from pathlib import Path
from typing import Any, NamedTuple


class Answer(NamedTuple):
    task: str
    format: str
    text: str
    steps: list[list[str]]  # the conditions as queries, and the skills as they are written
    notes: list[str] = []  # parts of notes, each with its line
    reason: str = ""


TABLE: dict[str, Any] = tomllib.loads((Path(__file__).parent / "answers.toml").read_text("utf-8"))
ANSWERS = {name: Answer(**row) for name, row in TABLE.items()}
GRIPPER = "the robot's gripper is"
