"""A parser that builds choices, loops and actions from the clauses of a line."""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from lw_torchrl._util.checks import shown
from lw_torchrl.language.expressions import FALSE, Expression, all_of, any_of, negate
from lw_torchrl.language.formats.base import PROGRAM_WORDS
from lw_torchrl.language.formats.clauses import PATTERNS, RELATION, Clause, action, base_verb, clauses
from lw_torchrl.language.formats.phrases import role_of
from lw_torchrl.language.formats.prose import MAY_BE_RULE, NO_SKILL
from lw_torchrl.language.programs import Action, Jump, Label, Node

if TYPE_CHECKING:
    from lw_torchrl.language.formats.sentences import SentenceReading

_WORDS = PROGRAM_WORDS["prose"]
_STOPS = (".", ";", "?")
_BACK = ("else", "rest", "yes", "no", "same", "different", "not", "case")  # refer to an earlier condition


@dataclass
class Choice:
    """A chain of "if ..., otherwise, if ..., otherwise ..." that later sentences may extend."""

    branches: list[tuple[Expression, list[Part]]] = field(default_factory=list)
    otherwise: list[Part] | None = None


@dataclass(frozen=True)
class Repeat:
    """An instruction to repeat the steps from a given number on ("" for all steps) while a condition is true."""

    first: str
    condition: Expression


@dataclass
class Open:
    """A choice that a later "otherwise", "yes" or "no" may refer to."""

    choice: Choice
    scopes: list[list[Part]]  # the scopes that are open where the choice begins
    is_question: bool = False
    is_exception: bool = False  # after "unless"
    is_answered: bool = False  # whether "yes" was read

    @property
    def is_last(self) -> bool:
        """Whether no other part follows the choice."""
        return next((part for part in reversed(self.scopes[-1]) if not isinstance(part, Label)), None) is self.choice


Part = Node | Choice | Repeat


class LineParser:
    """A parser of one line, which adds the clauses of the line to the reading one after another."""

    def __init__(self, reading: SentenceReading, content: str, is_item: bool, is_head: bool, is_heading: bool) -> None:
        self.reading, self.refers, self.opens = reading, reading.refers, reading.opens
        self.is_item, self.is_head, self.is_heading = is_item, is_head, is_heading
        self.clauses, self.at = clauses(content), 0
        self.scopes = reading.scopes
        self.start = self.kept = self.inner = len(self.scopes)  # scopes to keep after the line, "." and ";"
        self.acts = list[tuple[list[Part], Part]]()  # the actions since the last condition, and their scopes
        self.pending: Open | None = None  # the choice that a preceding "otherwise" extends
        self.before = Clause("say", "", stop=".")
        self.is_open = False  # whether no action follows the last condition
        self.guards = list[tuple[Expression, list[Part]]]()  # the conditions of the line, with the scopes they guard

    def read(self) -> None:
        while self.at < len(self.clauses):
            clause = self.clauses[self.at]
            self.at += 1
            self.ended(clause)
            if clause.kind in ("if", "unless", "until"):
                self.conditional(clause)
            elif clause.kind in _BACK:
                self.refer(clause)
            elif clause.kind == "ask":
                self.ask(clause)
            elif self.is_consequence(clause):
                self.act(replace(clause, kind="act"))
            elif clause.kind == "state":
                self.state(clause)
            elif clause.kind in ("act", "after", "before"):
                self.act(clause)
            else:
                self.say(clause)
            self.before = self.clauses[self.at - 1]
            if self.before.stop == ":":
                self.inner = len(self.scopes)
        self.open_otherwise()

    @property
    def next(self) -> Clause:
        """The clause after the current one; an empty clause at the end of the line."""
        return self.clauses[self.at] if self.at < len(self.clauses) else Clause("say", "", stop=".")

    def ended(self, clause: Clause) -> None:
        """Close the scopes of the previous sentence, unless this clause refers back to that sentence."""
        stop = self.before.stop
        if stop in (".", "!", ";") and self.before.kind not in _BACK:
            if stop == "." and self.before.kind in ("if", "unless") and self.is_open:
                self.kept = self.inner = len(self.scopes)  # "Suppose the gripper is open."
            self.acts, self.pending = [], None
            if clause.kind not in _BACK:
                if stop != ";":
                    self.inner = self.kept
                del self.scopes[self.inner if stop == ";" else self.kept :]

    def is_in_sentence(self, *kinds: str) -> bool:
        """Return whether a clause of one of these kinds follows in the same sentence."""
        for before, clause in itertools.pairwise(self.clauses[self.at - 1 :]):
            if before.stop in _STOPS:
                return False
            if clause.kind in kinds:
                return True
        return False

    def is_consequence(self, clause: Clause) -> bool:
        """Return whether a clause must be an action, though its verb is unknown: "if the gripper is open, wave"."""
        is_open = self.pending is not None or (len(self.scopes) > self.start and not self.acts)
        is_after = self.before.kind in ("if", "unless", "ask", *_BACK) and self.before.stop in (",", ":", "?", "")
        is_after |= self.before.kind == "state" and self.before.stop == ":"
        return is_open and is_after and clause.joint not in ("and", "or") and self.may_be_action(clause)

    def is_listed(self, clause: Clause) -> bool:
        """Return whether a clause continues a list of actions: "..., and wave" or "...; then wave"."""
        return bool(self.acts) if clause.joint == "and" or not clause.joint else clause.joint == "then" and self.at > 1

    def may_be_action(self, clause: Clause) -> bool:
        """Return whether a clause may begin with an unknown verb."""
        first = clause.text.partition(" ")[0].lower()
        is_known = first in (*NO_SKILL, *_WORDS["looks"], *_WORDS["no_verbs"], "")
        is_known |= any(PATTERNS[name].match(clause.text) is not None for name in ("announces", "repeat", "relation"))
        return clause.kind == "say" and not is_known

    # Conditions

    def condition(self, clause: Clause) -> Expression:
        """Convert a condition with the clauses that continue it: "if the gripper is near the mug, open or above it"."""
        text, tests, negative = clause.text, list[Expression](), clause.kind in ("unless", "until")
        stop, word = clause.stop, ""
        while stop in ("", ",") and self.at < len(self.clauses):
            following = self.next
            if following.kind == "state":
                joint = "and" if following.joint in ("so", "then") else following.joint
                text += f"{stop} {joint} {following.text}"
            elif following.kind in ("if", "unless") and following.joint in ("or", "and"):
                test = self.refers.condition(text)
                tests.append(negate(test) if negative else test)
                word, text, negative = following.joint, following.text, following.kind == "unless"
            else:
                break
            stop = following.stop
            self.at += 1
        test = self.refers.condition(text)
        tests.append(negate(test) if negative else test)
        return tests[0] if not tests[1:] else (any_of if word == "or" else all_of)(tests)

    def conditional(self, clause: Clause) -> None:
        """Add a condition that guards the actions before or after it."""
        acts, stop = self.acts, clause.stop
        after = next((each for each in self.clauses[self.at :] if each.kind != "state"), Clause("say", ""))
        is_led = stop == "" and len(self.scopes) > self.start and after is self.next
        is_led |= self.before.stop == "," and (stop in (",", ":") or after.joint == "then")
        is_aside = is_led and after.kind == "act"  # whether the condition guards the action after it
        if acts and isinstance(last := acts[-1][1], Action):
            self.refers.acted(last.text)
            if clause.kind == "until" and not clause.joint:
                self.replace([acts[-1]], Action(f"{last.text} until {clause.text}", last.line))
                return
        if acts and not ((clause.joint or is_aside) and self.is_in_sentence("act", "after", "state", "say", *_BACK)):
            self.trail(self.condition(clause), clause.kind == "unless")
            return
        test = self.condition(clause)
        is_other = any(self.opposes(scope, test) for scope in self.scopes[self.start :])
        is_beside = self.before.stop == "," and stop == ":" and len(self.scopes) == self.start + 1  # "if A: B, if C: D"
        if is_beside or (self.before.stop == "." and is_other):
            del self.scopes[self.start :]
            self.kept = self.inner = self.start
        self.is_open = self.before.stop in (".", ":", ";") and RELATION.search(clause.text) is not None
        joint = "then" if clause.joint == "then" else clause.word
        self.lead(test, clause.kind == "unless", "" if is_other else joint)

    def lead(self, test: Expression, is_exception: bool = False, joint: str = "") -> None:
        """Open a branch for the actions after a condition."""
        body = list[Part]()
        if self.pending is not None:
            choice, pending = self.pending.choice, self.pending
            choice.branches.append((test, body))
            self.pending = None
            self.opens.append(pending)
        else:
            if self.acts and joint not in ("once", "as soon as", "then"):
                del self.scopes[self.inner :]
            choice = Choice([(test, body)])
            self.scopes[-1].append(choice)
            self.opens.append(Open(choice, [*self.scopes], is_exception=is_exception))
        self.scopes.append(body)
        self.guards.append((test, body))
        self.acts = []

    def opposes(self, scope: list[Part], test: Expression) -> bool:
        """Return whether a condition is the opposite of the condition of a scope."""
        guard = next((each for each, body in self.guards if body is scope), test)
        return guard != test and str(guard).replace(" not ", " ") == str(test).replace(" not ", " ")

    def trail(self, test: Expression, is_exception: bool) -> None:
        """Make the last actions depend on the condition after them."""
        choice = Choice([(test, [part for _, part in self.acts])])
        self.replace(self.acts, choice)
        self.opens.append(Open(choice, [*self.scopes], is_exception=is_exception))
        self.acts = []

    def replace(self, acts: list[tuple[list[Part], Part]], *new: Part) -> list[Part]:
        """Replace actions with other parts, and return their scope."""
        scope = acts[0][0]
        place = next(number for number, part in enumerate(scope) if part is acts[0][1])
        scope[place : place + len(acts)] = new
        self.acts = [(scope, part) for part in new]
        return scope

    # Words that refer to an earlier condition

    def open(self, answer: str = "", is_here: bool = False) -> Open | None:
        """Return the innermost choice without "otherwise", or question without an answer, that is still open here."""
        for each in reversed(self.opens):
            if is_here and len(each.scopes) != len(self.scopes):
                continue
            depth = min(len(each.scopes), self.start)
            is_closed = each.is_answered if answer == "yes" else each.choice.otherwise is not None
            if is_closed or (answer and not each.is_question):
                continue
            is_near = each.is_question or len(each.scopes) >= self.start
            is_near &= all(a is b for a, b in zip(each.scopes[:depth], self.scopes[:depth], strict=True))
            if is_near and each.is_last:
                return each
        return None

    def refer(self, clause: Clause) -> None:
        """Continue in the branch that "otherwise", "if so" or "in that case" refers to, or open that branch."""
        kind, is_same = clause.kind, clause.kind in ("same", "yes")
        answer = "yes" if is_same else "no" if kind in ("different", "no", "not") else ""
        question = self.open(answer) if answer else None
        if question is not None and (kind in ("yes", "no", "same") or question is self.open()):
            question.is_answered |= is_same
            body = question.choice.branches[0][1] if is_same else list[Part]()
            question.choice.otherwise = question.choice.otherwise if is_same else body
            self.enter(question, body)
        elif kind in ("same", "yes", "no") or (kind == "different" and self.open() is None):
            self.same(self.refers.last if is_same else negate(self.refers.last))
        elif kind == "case" and self.opens and self.pending is None:
            choice = self.opens[-1].choice
            choice.otherwise = [] if self.opens[-1].is_exception and choice.otherwise is None else choice.otherwise
            self.enter(self.opens[-1], choice.branches[-1][1] if choice.otherwise is None else choice.otherwise)
            self.inner = len(self.scopes) if self.before.stop == "." else self.inner
        elif kind != "case":
            self.otherwise(clause)
        last = self.refers.last
        if self.next.kind == "state" and self.next.joint:  # "otherwise, but the gripper is near the mug, ..."
            self.at += 1
            self.lead(self.condition(self.clauses[self.at - 1]), joint="then")
        self.refers.last = last

    def enter(self, each: Open, body: list[Part]) -> None:
        """Parse the next clauses into ``body``, a branch of the choice ``each``."""
        self.scopes[:] = [*each.scopes, body]
        self.acts, self.pending = [], None

    def same(self, test: Expression) -> None:
        """Add the condition of "if it is" or "if it isn't". It may be the opposite case of the previous choice."""
        if self.before.stop in (".", ";"):
            del self.scopes[self.inner if self.before.stop == ";" else self.kept :]
        above = self.open()
        if above is not None and all_of([above.choice.branches[-1][0], test]) == FALSE:
            self.scopes[:] = above.scopes
            self.pending = above
        self.lead(test)

    def otherwise(self, clause: Clause) -> None:
        """Add an "otherwise" branch to the innermost choice that has none."""
        acts = self.acts if clause.stop in (".", ";") or self.at == len(self.clauses) else []
        parts = [part for _, part in acts]
        place = next((number for number, part in enumerate(acts[0][0]) if part is parts[0]), 0) if acts else 0
        scope = self.replace(acts) if acts else []  # "..., or lower it otherwise."
        is_bullet = self.is_item and self.at == 1
        above, question = (is_bullet and self.open(is_here=True)) or self.open(), self.open("yes")
        is_inner = question is not None and (above is None or len(above.scopes) <= len(question.scopes))
        if question is not None and is_inner and question.choice.otherwise is not None:
            question.is_answered = True  # after "no"
            self.enter(question, question.choice.branches[0][1])
            return
        if above is None:
            scope[place:place] = parts
            return
        siblings = self.siblings(above)
        if (clause.kind == "rest" or (is_bullet and not self.reading.step)) and len(siblings) > 1:
            choice = Choice([(any_of(test for each in siblings for test, _ in each.branches), [])])
            above.scopes[-1].append(choice)
            above = Open(choice, above.scopes)
            self.opens.append(above)
        if acts:
            above.choice.otherwise, self.acts = parts, []
            return
        self.scopes[:] = above.scopes
        self.acts, self.pending = [], above

    def siblings(self, above: Open) -> list[Choice]:
        """Return a choice and the choices directly before it that have no "otherwise"."""
        row = list[Choice]()
        for part in reversed(above.scopes[-1]):
            if isinstance(part, Choice) and part.otherwise is None:
                row.insert(0, part)
            elif not isinstance(part, Label):
                break
        return row

    def ask(self, clause: Clause) -> None:
        """Begin a choice whose condition is a question; later clauses give its cases: "Is it open? If yes, ..."."""
        is_known = RELATION.search(clause.text) or self.refers.is_named(clause.text)
        if not is_known and self.next.kind not in ("yes", "no", "not", "same", "different"):
            return
        self.open_otherwise()
        text = re.sub(r",? or not$", "", clause.text) + "?" * (clause.stop == "?")
        choice = Choice([(self.condition(Clause("if", text, stop=".")), [])])
        self.scopes[-1].append(choice)
        question = Open(choice, [*self.scopes], is_question=True)
        self.opens.append(question)
        if clause.stop == "?" and self.next.kind not in ("yes", "no", "same", "different", "not", "else", "rest"):
            self.scopes.append(choice.branches[0][1])
            self.inner = len(self.scopes)

    # Other clauses

    def open_otherwise(self) -> None:
        """Open the last branch of the choice that "otherwise" extends."""
        if self.pending is not None:
            self.pending.choice.otherwise = list[Part]()
            self.scopes.append(self.pending.choice.otherwise)
            self.pending = None

    def state(self, clause: Clause) -> None:
        """Use a description of the scene as the condition of the clauses after it, if it introduces a case."""
        end = self.at
        while end < len(self.clauses) and self.clauses[end - 1].stop in ("", ",") and self.clauses[end].kind == "state":
            end += 1
        stop, has_next = self.clauses[end - 1].stop, end < len(self.clauses)
        following = self.clauses[end] if has_next else Clause("say", "")
        begins = self.before.stop in (".", ";", ":") or self.before.kind == "say"
        is_labelled = self.is_item or self.is_heading or self.before.stop == ":"
        is_labelled |= PATTERNS["label"].match(self.before.text) is not None  # "Case A - the gripper is open."
        is_bare = following.kind == "act" and not PATTERNS["is"].search(clause.text)  # "gripper near the mug"
        is_case = stop == ":" or following.kind == "case"
        is_case |= stop in (".", "?") and begins and has_next and (is_labelled or is_bare)
        is_guard = following.joint == "then" or (begins and not following.told and following.joint != "so")
        is_case |= stop in (",", ";") and following.kind == "act" and is_guard
        is_case |= self.is_head and not has_next and (self.is_heading or stop != ".")
        if is_case:
            self.lead(self.condition(Clause("if", clause.text, stop=clause.stop)))
            self.inner = len(self.scopes) if stop in (".", ";") else self.inner
            self.kept = self.inner if stop == "." else self.kept
        elif len(self.scopes) > self.start and not self.acts and (text := action(clause.text, is_certain=True)):
            self.act(Clause("act", text, clause.joint, clause.stop))
        else:
            self.say(clause)

    def say(self, clause: Clause) -> None:
        """Append a note on a clause that is not part of the plan, and remember the objects that it mentions."""
        text = clause.text
        if self.at == 1 and clause.stop == ":" and role_of(text) == "comment":
            self.at = len(self.clauses)
            return
        if stated := PATTERNS["stated"].match(text):
            self.refers.condition(stated[1])
        is_announcement = PATTERNS["announces"].match(text) or text.partition(" ")[0].lower() in _WORDS["looks"]
        if is_announcement and self.before.kind in ("if", "unless"):
            self.inner = len(self.scopes)
            self.kept = self.inner if clause.stop == "." else self.kept
        if repeat := PATTERNS["repeat"].match(text):
            self.repeat(repeat, clause.stop)
        elif self.is_listed(clause) and self.may_be_action(clause):
            self.reading.note(self.reading.line, f"{shown(text)} is left out: it does not begin with a known verb")
        elif text and MAY_BE_RULE.match(text):
            self.reading.note(self.reading.line, f"{shown(text)} is left out: its condition is not understood")

    def repeat(self, repeat: re.Match[str], stop: str) -> None:
        """Add a loop over the preceding steps, or let the loop's condition guard the items that follow."""
        test = self.refers.condition(repeat[3].rstrip(":"))
        test = negate(test) if repeat[2].lower() == "until" else test
        if self.is_head or stop == ":":
            self.lead(test)
        else:
            step = str(self.reading.step or "") if self.at > 1 else ""
            self.reading.root.append(Repeat(repeat[1] or step, test))

    def act(self, clause: Clause) -> None:
        """Add an action."""
        text, reading = clause.text, self.reading
        if repeat := PATTERNS["repeat"].match(text):
            self.repeat(repeat, clause.stop)
            return
        is_short = len(text.split()) <= 4 and not re.search(r"\b(?:the|it|its|a)\b", text)
        is_title = clause.stop in (":", ".") and self.next.kind in ("if", "unless", "ask", *_BACK)
        is_title |= self.is_head or PATTERNS["label"].match(text) is not None
        is_label = (self.at == 1 or self.before.kind == "say" or self.is_heading) and is_short and is_title
        beside = [each.text for each in (self.before, self.next) if each.kind == "act"]
        is_label |= " " not in text and any(" " not in each for each in beside)  # "three phases: rise, cross, press"
        is_label |= self.is_heading and PATTERNS["title"].match(self.before.text) is not None  # "Stage 1: get the puck"
        is_announced = text.lower() in _WORDS["details"]
        if is_label or is_announced or text.split(" ")[0].lower() in (*NO_SKILL, *_WORDS["looks"]):
            return
        joint = clause.joint if self.before.text else self.before.joint  # "First, the robot ..."
        is_guarded = len(self.scopes) > 1 or self.pending or self.is_item or joint in ("and", "then")
        is_conditional = " until " in text or (self.next.kind in ("if", "unless") and clause.stop in ("", ","))
        if clause.told and not is_guarded and not self.opens and not is_conditional:
            reading.note(reading.line, f"{shown(clause.word)} is left out: it describes the plan")
            return
        if clause.stop == ":" and self.at < len(self.clauses):  # an announcement
            self.open_otherwise()
            return
        if clause.kind == "before" and not self.acts:
            return
        self.open_otherwise()
        self.is_open = False
        if self.before.stop == "," and clause.kind == self.before.kind == "act":
            self.acts = []
        if text.endswith(" instead") and len(self.opens) > 0:
            self.replace_last()
        self.place(clause, re.sub(r"(?:,? (?:instead|first|again|then))+$", "", text), self.scopes[-1])

    def replace_last(self) -> None:
        """Move the last action to the else branch of the new choice: "if it is open, close it instead"."""
        opened = self.opens[-1]
        before = [part for part in opened.scopes[-1] if part is not opened.choice]
        if opened.choice.branches[-1][1] is not self.scopes[-1] or len(before) == len(opened.scopes[-1]):
            return
        parts: list[Part] = [part for part in before if not isinstance(part, Label)]
        while parts and isinstance(last := parts[-1], Choice):
            parts = last.branches[-1][1] if last.otherwise is None else last.otherwise
        if parts and isinstance(parts[-1], Action):
            opened.choice.otherwise = [last := parts[-1]]
            scope = next((part for part in (before, parts) if any(each is last for each in part)), parts)
            scope[:] = [opened.choice if part is last else part for part in scope]
            opened.scopes[-1][:] = before

    def place(self, clause: Clause, text: str, scope: list[Part]) -> None:
        """Add an action to a scope."""
        kept, last = PATTERNS["kept"].match(text), scope[-1] if scope else None
        if go_to := PATTERNS["go_to"].match(text):
            is_later = int(go_to[1]) > self.reading.step
            scope.append(Jump(go_to[1] if is_later else ""))
            self.reading.has_jumps |= is_later
        elif kept and isinstance(last, Action) and last.text.split()[0] == base_verb(kept[1]):
            self.replace([(scope, last)], Action(last.text + (kept[2] or ""), last.line))
        elif text.lower() not in _WORDS["continues"]:
            is_first = not any(isinstance(part, Action) for part in scope)
            part = Action(self.refers.action(text, is_first), self.reading.line)
            if clause.kind == "after" and self.acts:
                self.replace(self.acts, part, *(before for _, before in self.acts))
                self.acts = [(scope, part)]
                return
            is_end = PATTERNS["ends"].match(text) and not (self.next.kind == "act" and clause.stop in ("", ","))
            new: list[Part] = [part, Jump()] if is_end else [part]
            scope += new
            self.acts += [(scope, each) for each in new]
