"""How a plan writes its skills: with the article before the nouns of its task."""

from __future__ import annotations

import re

from lw_torchrl.language.tasks import Task

# fmt: off
_BEFORE_NOUN = {
    "above", "across", "against", "along", "and", "around", "at", "away", "back", "behind", "below", "beside",
    "between", "by", "down", "from", "in", "inside", "into", "near", "of", "off", "on", "onto", "or", "out", "over",
    "past", "through", "to", "toward", "towards", "under", "up", "with",
}
# fmt: on
_LONGEST_BEFORE = max(map(len, _BEFORE_NOUN))


def canonical_skill(skill: str, task: Task) -> str:
    """The skill in plain English: articles go before the nouns that lack one, as in the paper.

    A noun lacks one at the beginning and after a word like "above"; after any other word ("the coffee mug") it
    is part of something longer and is left alone.
    """
    first, _, details = " ".join(skill.split()).partition(" ")
    verb, *rest = first.replace("_", " ").split() or [""]
    if not re.fullmatch(r"[A-Za-z]\w*", verb):
        raise ValueError(f"skill must begin with a plain word like 'place', got {skill!r}")
    details = " ".join([*rest, _with_articles(details, task)]).strip()
    return f"{verb} {_with_articles(details, task)}".strip()


def _with_articles(details: str, task: Task) -> str:
    def article(match: re.Match[str]) -> str:
        end = match.start() - (details[match.start() - 1 : match.start()] == " ")
        start = max(0, end - _LONGEST_BEFORE - 1)  # no further: a text may be all nouns
        before = details[start:end].rpartition(" ")[2]
        return f"the {match[0]}" if not before or before in _BEFORE_NOUN else match[0]

    nouns = sorted({*task.object_names, "gripper"}, key=len, reverse=True)
    pattern = "|".join(re.escape(noun) for noun in nouns)
    return re.sub(rf"(?<![\w'-])(?:{pattern})(?![\w'-])", article, details)
