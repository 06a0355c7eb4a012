"""The words that join conditions: "and", "or", "unless", "either ... or", "neither ... nor", "once" and parentheses."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field

from lw_torchrl.language.expressions import Expression, all_of, any_of, negate, once

CONNECTIVES = ("and", "or", "nor", "unless", "either", "neither", "both")
"""The words that join conditions. Names of objects and relations must not contain them."""
OPENERS = ("(", "either", "both", "neither")
"""The words that open a group of conditions."""


@dataclass(slots=True)
class _Group:
    """The operands that a parser has read since a parenthesis, "either", "both" or "neither"."""

    opener: str
    negated: bool
    is_latch: bool = False  # "once (...)"
    negated_inside: bool = False  # "once not (...)"
    parts: list[Expression] = field(default_factory=list)  # joined by "and"
    alternatives: list[Expression] = field(default_factory=list)  # joined by "or"
    exceptions: list[Expression] = field(default_factory=list)  # the main condition, then those after each "unless"

    def end(self, joined: list[Expression]) -> None:
        """End the current conjunction; if ``joined`` is ``exceptions``, also end the current disjunction."""
        if self.parts:
            self.alternatives.append(all_of(self.parts))
            self.parts = []
        if joined is self.exceptions and self.alternatives:
            joined.append(any_of(self.alternatives))
            self.alternatives = []

    def add(self, part: Expression | None, negated: bool) -> None:
        if part is not None:
            self.parts.append(negate(part) if negated else part)

    @property
    def condition(self) -> Expression | None:
        self.end(self.exceptions)
        if not self.exceptions:
            return None
        first, *others = self.exceptions
        condition = all_of([first, *map(negate, others)])
        condition = negate(condition) if self.negated_inside else condition
        return once(condition) if self.is_latch else condition


_PARTNERS = {"neither": "nor", "either": "or", "both": "and"}


def repeat_predicate(words: Sequence[str], relations: Collection[str]) -> list[str]:
    """Repeat a predicate that two subjects share, so that each operand is a complete clause.

    Args:
        relations: the words with which a predicate can begin.

    Example:
        >>> " ".join(repeat_predicate("neither a nor b is near c".split(), {"is", "near"}))
        'neither a is near c nor b is near c'
    """
    words = list(words)
    for start, word in enumerate(words):
        if (partner := _PARTNERS.get(word)) is None or partner not in words[start:]:
            continue
        middle = words.index(partner, start)
        stops = {*relations, *CONNECTIVES, "(", ")"}
        verb = next((number for number in range(middle + 1, len(words)) if words[number] in stops), None)
        if verb is None or verb == middle + 1 or words[verb] not in relations or stops & {*words[start + 1 : middle]}:
            continue
        end = next((number for number in range(verb, len(words)) if words[number] in (*CONNECTIVES, ")")), len(words))
        predicate = ["is" if each == "are" else each for each in words[verb:end]]
        words[verb:end] = predicate
        words[middle:middle] = predicate
        return repeat_predicate(words, relations)
    return words


# The groups that each word closes. ")" and the end of the text close all groups except those opened by "(".
_ENDS = {"and": ("neither",), "or": ("both", "neither"), "nor": ("both", "either")}


def parse_words(
    words: Sequence[str], operand: Callable[[list[str]], Expression | None], fail: Callable[[int, str], Exception]
) -> Expression | None:
    """Parse a condition in English: "A or B", "not (A and B)", "neither A nor B", "A unless B", "once (A and B)".

    "and" binds tighter than "or", and "unless" binds loosest. The words before a parenthesis, "either", "both" or
    "neither" belong to the first operand of that group: "the gripper is (open or closed)".

    Args:
        words: words and parentheses.
        operand: a function that parses the words of an operand, or returns None to skip the operand. The function is
            called in the order of the text.
        fail: a function that returns the error to raise, given the index of the faulty word and what was expected.
    """
    stack, pending, negated, expects = [_Group("", False)], list[str](), False, True
    for number, given in enumerate((*words, "")):
        word = given.casefold()
        opens = word in OPENERS
        if not expects and (opens or word not in ("", ")", *CONNECTIVES)):
            raise fail(number, "'and', 'or' or the end of the condition")
        if opens:
            # In "the gripper is not (A or B)", "not" negates the group, and "the gripper is" begins A.
            before = [each.casefold() for each in pending]
            is_latch = "once" in before and {*before} <= {"not", "once"}
            outside = before[: before.index("once")] if is_latch else before
            for denied in ("not", "isn't"):
                negated ^= outside.count(denied) % 2 == 1
            pending = [
                "is" if lower == "isn't" else each
                for lower, each in zip(before, pending, strict=True)
                if lower != "not" and not is_latch
            ]
            is_neither = word == "neither"
            inside = is_latch and (is_neither != (len(before) - len(outside) == 2))  # "once not (A)"
            stack.append(_Group(word, negated != (is_neither and not is_latch), is_latch, inside))
            negated = False
        elif word not in ("", ")", *CONNECTIVES):
            pending.append(given)
        else:
            if expects:
                stack[-1].add(operand(pending), negated)
                pending, negated = [], False
            while stack[-1].opener in _ENDS.get(word, ("either", "both", "neither")):
                group = stack.pop()
                stack[-1].add(group.condition, group.negated)
            if word in ("", ")"):
                if (stack[-1].opener == "(") != (word == ")"):
                    raise fail(number, "')'" if stack[-1].opener else "no ')', since no '(' comes before")
                if word == ")":
                    group = stack.pop()
                    stack[-1].add(group.condition, group.negated)
            elif word == "unless":
                stack[-1].end(stack[-1].exceptions)
            elif word == "or" or stack[-1].opener == "neither":
                stack[-1].end(stack[-1].alternatives)
            negated = word == "nor" and stack[-1].opener != "neither"
            expects = word not in ("", ")")
    return stack[0].condition
