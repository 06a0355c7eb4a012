"""Programs become plans: the active actions are those that the program itself would carry out."""

import json
import sys
from contextlib import suppress
from itertools import product

import pytest
from cases import read_cases
from conditions import visit_with_memory
from hypothesis import given, settings
from hypothesis import strategies as st
from speed import within

import lw_torchrl as lw
from lw_torchrl.language.canonical import explain_canonical
from lw_torchrl.language.expressions import as_expression, evaluate, fold, negate
from lw_torchrl.language.formats.code import CodeReading
from lw_torchrl.language.library import LIBRARY
from lw_torchrl.language.plan_files import parse_plan
from lw_torchrl.language.programs import (
    Action,
    Block,
    Branch,
    Check,
    Jump,
    Label,
    Loop,
    ProgramError,
    Selector,
    Sequence,
    compile_program,
)
from lw_torchrl.language.queries import parse_query

CASES = read_cases("language/queries.toml")
LEAVES = ("a", "b", "c", "d")
STATES = [dict(zip(LEAVES, truth, strict=True)) for truth in product((False, True), repeat=len(LEAVES))]

# Programs as nested tuples, with the source of each and an interpreter.
conditions = st.recursive(
    st.sampled_from(LEAVES).map(lambda leaf: ("check", leaf)),
    lambda inner: st.one_of(
        st.tuples(st.just("not"), inner),
        st.tuples(st.sampled_from(("and", "or", "any", "all")), inner, inner),
        st.tuples(st.just("if"), inner, inner, inner),
        st.tuples(st.just("helper"), inner),
    ),
    max_leaves=4,
)
actions = st.tuples(st.just("do"), st.integers(0, 99))
simple = st.one_of(actions, st.just(("return",)), st.tuples(st.just("return"), st.integers(100, 199)))
blocks = st.recursive(
    st.lists(simple, min_size=1, max_size=2),
    lambda inner: st.lists(
        st.one_of(
            simple,
            st.tuples(st.just("if"), st.lists(st.tuples(conditions, inner), min_size=1, max_size=3), inner | st.none()),
            st.tuples(st.just("while"), conditions, inner),
            st.tuples(st.just("while true"), conditions, inner),
            st.tuples(st.just("name"), conditions, inner),
            st.tuples(st.just("words"), conditions, st.integers(200, 299)),
        ),
        min_size=1,
        max_size=4,
    ),
    max_leaves=10,
)


class Source:
    """The Python source of a program."""

    def __init__(self, program):
        self.names, self.helpers = 0, []
        body = self.block(program, 1)
        self.text = "\n".join([*self.helpers, "def policy(robot):", *body])

    def condition(self, row):
        kind, *parts = row
        if kind == "check":
            return f'check("{parts[0]}")'
        inner = [self.condition(part) for part in parts]
        if kind == "not":
            return f"not ({inner[0]})"
        if kind in ("any", "all"):
            return f"{kind}([{inner[0]}, {inner[1]}])"
        if kind == "if":
            return f"(({inner[1]}) if ({inner[0]}) else ({inner[2]}))"
        if kind == "helper":
            self.names += 1
            self.helpers += [
                f"def helper_{self.names}():",
                f"    if {inner[0]}:",
                "        return True",
                "    return False",
            ]
            return f"helper_{self.names}()"
        return f"(({inner[0]}) {kind} ({inner[1]}))"

    def block(self, rows, depth):
        lines, gap = [], "    " * depth
        for kind, *parts in rows:
            if kind == "do":
                lines.append(f'{gap}robot.wave("to {parts[0]}")')
            elif kind == "return":
                lines.append(gap + (f'return robot.wave("to {parts[0]}")' if parts else "return"))
            elif kind == "if":
                for number, (condition, body) in enumerate(parts[0]):
                    word = "elif" if number else "if"
                    lines += [f"{gap}{word} {self.condition(condition)}:", *self.block(body, depth + 1)]
                if parts[1] is not None:
                    lines += [f"{gap}else:", *self.block(parts[1], depth + 1)]
            elif kind == "while":
                lines += [f"{gap}while {self.condition(parts[0])}:", *self.block(parts[1], depth + 1)]
            elif kind == "while true":
                lines += [f"{gap}while True:", f"{gap}    if {self.condition(parts[0])}:", f"{gap}        break"]
                lines += self.block(parts[1], depth + 1)
            else:
                self.names += 1
                name = f"name_{self.names}"
                if kind == "name":
                    lines += [f"{gap}{name} = {self.condition(parts[0])}", f"{gap}if {name}:"]
                    lines += self.block(parts[1], depth + 1)
                else:
                    words = f'"to {parts[1]}" if {self.condition(parts[0])} else "to {parts[1] + 100}"'
                    lines += [f"{gap}{name} = {words}", f'{gap}robot.wave(f"{{{name}}}")']
        return lines


class _End(Exception):
    """The end of a control step."""


def holds(row, truth):
    kind, *parts = row
    if kind == "check":
        return truth[parts[0]]
    if kind == "if":
        return holds(parts[1] if holds(parts[0], truth) else parts[2], truth)
    inner = [holds(part, truth) for part in parts]
    return not inner[0] if kind == "not" else any(inner) if kind in ("or", "any") else all(inner)


def carried_out(rows, truth, done):
    """Carry out a program in one state; a loop that goes on ends the control step."""
    for kind, *parts in rows:
        if kind == "do" or (kind == "return" and parts):
            done.add(parts[0])
        if kind == "return":
            raise _End
        if kind == "if":
            chosen = next((body for condition, body in parts[0] if holds(condition, truth)), parts[1])
            carried_out(chosen or [], truth, done)
        elif (kind == "while" and holds(parts[0], truth)) or (kind == "while true" and not holds(parts[0], truth)):
            carried_out(parts[1], truth, done)
            raise _End
        elif kind == "name" and holds(parts[0], truth):
            carried_out(parts[1], truth, done)
        elif kind == "words":
            done.add(parts[1] + (0 if holds(parts[0], truth) else 100))


@settings(max_examples=300)
@given(blocks)
def test_a_program_activates_the_actions_that_it_carries_out(program):
    reading = CodeReading(Source(program).text)
    steps = compile_program(reading.section.tree) if reading.section.tree else []
    assert not reading.notes
    for truth in STATES:
        expected = set()
        with suppress(_End):
            carried_out(program, truth, expected)
        assert {int(step.action.text.split()[-1]) for step in steps if evaluate(step.guard, truth)} == expected


QUERIES = dict(
    zip(LEAVES, ("the gripper is open", "the gripper is near the puck", "the gripper is above the puck",
                 "the puck is near the target location"), strict=True)
)  # fmt: skip


@settings(max_examples=60)
@given(blocks, st.sampled_from(list(lw.PLAN_FORMATS)))
def test_a_compiled_plan_is_read_again_as_an_equal_plan(program, format):
    text = Source(program).text
    for leaf, query in QUERIES.items():
        text = text.replace(f'check("{leaf}")', f'check("{query}")')
    plan = lw.decode_plan(text, "push").plan
    if plan is not None:
        assert lw.decode_plan(str(plan), "push", "chain_py").plan == plan
        assert lw.decode_plan(lw.encode_plan(plan, format), "push", format).plan == plan
        assert lw.ConditionalPlan.from_json("push", plan.to_json()) == plan


def guards(node, **options):
    return [(str(step.guard), step.action.text) for step in compile_program(node, **options)]


def test_actions_in_turn_wait_for_the_effect_of_the_previous_one():
    node = Sequence((Action("open"), Action("wave"), Action("move")))
    found = guards(node, effect=lambda text: {"open": "is open", "move": "is there"}.get(text))
    assert found == [("not is open", "open"), ("is open", "wave"), ("is open", "move")]


def test_rules_side_by_side_do_not_wait_but_an_action_below_them_does():
    rules = [Branch(negate(negate("a")), Action("open")), Branch(negate("b"), Action("move"))]
    found = guards(Block((*rules, Action("wave"))), effect=lambda text: {"open": "is open"}.get(text))
    assert found == [("a and not is open", "open"), ("not b", "move"), ("not a or is open", "wave")]


def test_a_selector_tries_alternatives_and_runs_until_its_condition():
    at = Check(negate(negate("at")))
    approach = Selector((at, Sequence((Check(negate("high")), Action("lower"))), Action("move")))
    assert guards(Sequence((approach, Action("close")))) == [
        ("not at and not high", "lower"),
        ("not at and high", "move"),
        ("at", "close"),
    ]


def test_a_jump_skips_to_its_label_and_an_unknown_loop_runs_always():
    jump = Branch(negate(negate("held")), Jump("4"))
    body = Sequence((jump, Action("grasp")))
    node = Sequence((Loop(negate("grasped"), body), Label("4"), Action("lift")))
    assert guards(node) == [("not grasped and not held", "grasp"), ("grasped or not grasped and held", "lift")]
    assert guards(node, known=lambda text: text != "grasped")[0] == ("not held", "grasp")


@pytest.mark.parametrize("nested", [Branch, Loop])
def test_twenty_thousand_nested_parts_are_an_error_within_a_second(nested):
    node = Action("move up")
    for _ in range(20_000):
        node = nested(negate("the gripper is open"), node)
    with within(1):
        with pytest.raises(ProgramError, match="must nest at most"):
            compile_program(node)
        with pytest.raises(lw.PlanError, match="must nest at most"):
            lw.ConditionalPlan.from_program(node, "push")


def test_a_long_chain_of_elif_is_a_plan():
    rows = ["def push(robot):", '    if check("the gripper is open"):', '        robot.wave("0")']
    for number in range(150):
        rows += [f'    elif check("the puck is near the target location {number}"):', f'        robot.wave("{number}")']
    plan = lw.ConditionalPlan.from_program("\n".join(rows), "push")
    assert len(plan.steps) == 2  # all others are the same condition


DEEP = {
    "python": "def push(robot):\n" + "".join(f"{' ' * n}if check('gripper open'):\n" for n in range(1, 150)),
    "json": '{"if": "gripper open", "then": ' * 20_000,
    "not": f"def push(robot):\n    if {'not ' * 9_000}a: robot.wave('x')",
    "texts": "def push(robot):\n"
    + "".join(f"    s{n} = 'a' if check('c{n}') else 'b'\n" for n in range(40))
    + f"    robot.move({', '.join(f's{n}' for n in range(40))})",
    "growth": "def push(robot):\n    s = 'aa'\n" + "    s = s + s\n" * 60 + "    robot.move(s)",
    "calls": "".join(f"def f{n}(r):\n f{n + 1}(r)\n f{n + 1}(r)\n" for n in range(40)) + "def f40(r):\n r.go('x')",
    "prose": "1. " + "If the gripper is open: " * 2_000,
}  # fmt: skip


@pytest.mark.parametrize("name", DEEP)
def test_hostile_programs_are_read_in_time_without_an_error(name):
    with within(3):
        lw.decode_plan(DEEP[name], "push")


@pytest.mark.parametrize(("text", "query"), CASES["prose"])
def test_conditions_in_prose_keep_their_negations(text, query):
    plan = lw.decode_plan(f"Stop if {text}. Otherwise, push the puck.", "push").plan
    assert plan.steps[0].condition == parse_query(query, "push")


@pytest.mark.parametrize(("text", "same"), CASES["shared"])
def test_two_subjects_may_share_a_predicate(text, same):
    assert parse_query(text, "push") == parse_query(same, "push")


def test_yaml_without_pyyaml_gives_a_note(monkeypatch):
    monkeypatch.setitem(sys.modules, "yaml", None)
    decoded = lw.decode_plan("selector:\n  children:\n    - wave at the puck\n", "push")
    assert any("pip install pyyaml" in str(note) for note in decoded.notes)


CALLS = """
def pick_place(robot):
    robot.grasp("the puck")
    robot.place("the puck at the target location")
"""


def test_a_program_calls_programs_of_a_library():
    plan = lw.ConditionalPlan.from_program(CALLS, "pick-place", library=LIBRARY)
    assert [step.skill.split(" ")[0] for step in plan.steps] == ["close", "lower", "move", "open", "carry"]
    assert all("the robot's gripper is closed" in str(step.condition) for step in plan.steps[3:])  # once it is grasped
    assert explain_canonical(plan).source == "plan"
    assert lw.ConditionalPlan.from_program(CALLS, "pick-place").steps[0].skill == "grasp the puck"


def test_programs_of_a_library_must_not_call_themselves():
    library = {"grasp {it}": "If the gripper is open, fetch {it}.", "fetch {it}": "If the gripper is open, grasp {it}."}
    with pytest.raises(lw.PlanError, match="grasp the puck -> fetch the puck -> grasp the puck"):
        lw.ConditionalPlan.from_program(CALLS, "pick-place", library=library)


def test_from_program_names_the_reason():
    with pytest.raises(lw.PlanError, match="no steps for push"):
        lw.ConditionalPlan.from_program("I cannot do that.", "push")


def test_every_action_of_a_behaviour_tree_is_kept():
    def leaf(number):
        return {"type": "action", "do": f"wave to {number}"}

    tree = {"type": "selector", "children": [
        {"type": "sequence", "children": [{"type": "condition", "check": "gripper open"}, leaf(1)]},
        {"type": "sequence", "children": [{"type": "condition", "is": "gripper near puck", "negate": True}, leaf(2)]},
        leaf(3),
    ]}  # fmt: skip
    plan = lw.ConditionalPlan.from_program(json.dumps(tree), "push")
    assert [str(step.condition) for step in plan.steps] == [
        "the robot's gripper is open",
        "the robot's gripper is not open and the robot's gripper is not near the puck",
        "the robot's gripper is not open and the robot's gripper is near the puck",
    ]


# ---- sequences with memory and the perfect tense, which become latches

literals = st.builds(
    lambda name, negated: negate(name) if negated else as_expression(name), st.sampled_from(LEAVES), st.booleans()
)
effects = st.sampled_from(LEAVES).map(lambda name: Action(f"do {name}"))  # the effect of "do a" is a


def sequences(parts):
    return st.builds(
        lambda listed, memory: Sequence(tuple(listed), memory), st.lists(parts, min_size=1, max_size=3), st.booleans()
    )


stateful = st.recursive(
    effects | st.builds(Check, literals),
    lambda parts: sequences(parts) | st.builds(Branch, literals, parts, st.none() | parts),
    max_leaves=8,
).map(lambda node: Sequence((node, Action("do a")), memory=True))


class Ticker:
    """A behaviour tree that is ticked at each control step; a sequence with memory stores its next part."""

    def __init__(self):
        self.next = {}

    def tick(self, node, truth, path=()):
        """Return the status and the active actions."""
        if isinstance(node, Action):
            return "success" if truth[node.text[-1]] else "running", [node.text]
        if isinstance(node, Check):
            return "success" if evaluate(node.condition, truth) else "failure", []
        if isinstance(node, Branch):
            if evaluate(node.condition, truth):
                return self.tick(node.then, truth, (*path, 0))
            return ("success", []) if node.otherwise is None else self.tick(node.otherwise, truth, (*path, 1))
        active = []
        for number in range(self.next.get(path, 0) if node.memory else 0, len(node.parts)):
            status, active = self.tick(node.parts[number], truth, (*path, number))
            if status != "success":
                return status, active
            if node.memory:
                self.next[path] = number + 1
                active = []
        return "success", active


@given(stateful, st.lists(st.fixed_dictionaries({name: st.booleans() for name in LEAVES}), max_size=8))
def test_compiled_trees_with_memory_act_like_ticked_trees(tree, states):
    steps = compile_program(tree, lambda text: text[-1])
    ticker, latched = Ticker(), set()
    for truth in states:
        _, expected = ticker.tick(tree, truth)
        holds_now = visit_with_memory(truth, latched)
        truths = [fold(step.guard, holds_now) for step in steps]  # of each step, so that each latch is visited
        assert [step.action.text for step, active in zip(steps, truths, strict=True) if active] == expected


TREE = {
    "children": [
        {"type": "condition", "name": "the gripper is open"},
        {"type": "action", "name": "move the gripper above the puck"},
        {"type": "action", "name": "close the gripper"},
    ]
}


def test_spellings_of_a_sequence_with_memory():
    kinds = [{"type": kind} for kind in ("SequenceStar", "sequence_with_memory", "Sequence*")]
    texts = [json.dumps({**kind, **TREE}) for kind in [*kinds, {"type": "sequence", "memory": True}]]
    texts.append(json.dumps({"sequence_with_memory": TREE["children"]}))
    for plan in [lw.decode_plan(text, "push").plan for text in texts]:
        opened = "the robot's gripper has been open"
        above = f"once ({opened} and the robot's gripper is above the puck)"
        closed = f"once ({above} and the robot's gripper is closed)"
        conditions = [str(step.condition) for step in plan.steps]
        assert conditions == [f"{opened} and not {above}", f"{above} and not {closed}"]
        assert parse_plan(str(plan), "push") == plan
    without = lw.decode_plan(json.dumps({"type": "sequence", **TREE}), "push").plan
    assert not any(step.condition.has_latch for step in without.steps)
