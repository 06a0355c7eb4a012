"""From a model's words to what the library can do: a condition to the nearest query, a skill to the nearest scripted
one. The words of data/words.toml and the task's target are put into ours first.

Source: paper section 'LLM Experiments', which takes the nearest by string edit distance.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache, lru_cache
from importlib.resources import files
from typing import Literal

from lw_torchrl._files import read_toml
from lw_torchrl.language.queries import Query, QueryError, read_query
from lw_torchrl.language.query_search import nearest_query
from lw_torchrl.language.skills import ScriptedSkill, nearest_skill, skills_for
from lw_torchrl.language.tasks import Task

_LONGEST = 400  # characters of a text that is compared
_MOST_PARTS = 8  # clauses of a condition outside the language
_MOST_COMPARED = 64  # conditions and goals of an answer outside the language: a limit to its time
_TARGETS = ("target location", "reach target")
_TARGET = re.compile(
    r"\b(?:the\s)?(?:reach\s)?(?:goal|target)(?:\s(?:location|position|area|place|point|destination))?\b"
)


class StepMapper:
    """Maps the words of one answer. A distance is 1 less a similarity in [0, 1], after words were put into ours."""

    def __init__(
        self,
        task: Task,
        skills: Mapping[str, ScriptedSkill] | None,
        by: Literal["edit", "embedding"],
        limit: float,
        skill_limit: float,
    ) -> None:
        self.task, self.by, self.limit, self.skill_limit = task, by, limit, skill_limit
        self.skills = skills_for(task, skills)
        self.compared = 0

    def query(self, text: str) -> tuple[Query | None, float]:
        """The nearest query, None if its furthest clause is beyond the limit; and how far that clause is."""
        if (query := read_query(text, self.task)) is not None:
            return query, 0.0
        self.compared += 1
        if self.compared > _MOST_COMPARED or len(text) > _LONGEST:
            return None, 1.0
        found, distance = _nearest(text, self.task, self.by)
        return (found if distance <= self.limit else None), distance

    def skill(self, text: str) -> tuple[str | None, float]:
        """The text of the nearest scripted skill, None if it is beyond the limit; and how far it is."""
        if text in self.skills:
            return text, 0.0
        if not self.skills or len(text) > _LONGEST:
            return None, 1.0
        said = _with_target(text, self.task)
        if found := _phrases("skills").match(said):
            said = _words("skills")[found[0]] + said[found.end() :]
        skill, score = nearest_skill(said, None, self.skills, by=self.by)
        return (skill.text if 1.0 - score <= self.skill_limit else None), 1.0 - score


@lru_cache(maxsize=4096)
def _nearest(text: str, task: Task, by: Literal["edit", "embedding"]) -> tuple[Query | None, float]:
    said = _phrases("conditions").sub(lambda found: _words("conditions")[found[0]], _with_target(text, task))
    try:
        match = nearest_query(said, task, by=by)
    except QueryError:
        return None, 1.0
    if len(match.parts) > _MOST_PARTS:
        return None, 1.0
    return match.query, 1.0 - min(part.score for part in match.parts)


def _with_target(text: str, task: Task) -> str:
    """The text in lower case, with the task's own name for its goal, which models call "goal" or "target position"."""
    said = text.casefold()
    name = next((name for name in _TARGETS if name in task.object_names), None)
    if name is None:
        return said
    return _TARGET.sub(lambda found: found[0] if found[0] in task.object_names else f"the {name}", said)


@cache
def _words(kind: str) -> Mapping[str, str]:
    table: Mapping[str, str] = read_toml(files("lw_torchrl.language") / "data" / "words.toml", ValueError)[kind]
    return table


@cache
def _phrases(kind: str) -> re.Pattern[str]:
    """Any phrase of the table, the longest first; one that our own words begin with is left alone."""
    longest = sorted(_words(kind), key=len, reverse=True)
    return re.compile(rf"\b(?:{'|'.join(map(re.escape, longest))})\b")
