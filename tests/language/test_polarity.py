"""No reading of a sentence means the opposite: negations and opposites are kept, or left out with a note."""

import pytest
from cases import read_cases
from hypothesis import example, given, settings
from hypothesis import strategies as st
from plan_texts import read_table

import lw_torchrl as lw
from lw_torchrl.language.canonical import explain_canonical
from lw_torchrl.language.expressions import evaluate, leaves
from lw_torchrl.language.nearest import StepMapper, nearest_query, nearest_skill
from lw_torchrl.language.polarity import instruction
from lw_torchrl.language.queries import Query, base_clauses
from lw_torchrl.language.relations import PREDICATES
from lw_torchrl.language.skills import load_skills
from lw_torchrl.language.tasks import GOAL

CASES = read_cases("language/polarity.toml")
TASKS = ("push", "drawer-open", "stick-pull", "reach")


def implies(first, second):
    """Return whether the second query is true in each state in which the first is, of which there are some."""
    names = [*{*leaves(first.expression), *leaves(second.expression)}][:8]
    states = [{name: bool(number >> at & 1) for at, name in enumerate(names)} for number in range(2 ** len(names))]
    states = [state for state in states if evaluate(first.expression, state)]
    return bool(states) and all(evaluate(second.expression, state) for state in states)


def readings(text, task):
    """Return every reading of a condition: by decode_plan, and by nearest_query if the score is not 0."""
    decoded = lw.decode_plan(f"- When {text}, the robot should ponder it.\n", task, "basic_md")
    read = [step.condition for step in decoded.steps if step.condition is not None]
    if decoded.plan is None:
        assert decoded.notes
    return [*read, nearest_query(text, task).query]


@st.composite
def negations(draw):
    task = lw.TASKS[draw(st.sampled_from(TASKS))]
    clause = draw(st.sampled_from([c for c in base_clauses(task, tuple(PREDICATES)) if not c.negated]))
    if clause.predicate == "near" and draw(st.booleans()):
        return (
            task,
            Query((clause,)),
            f"the {clause.subject} is {draw(st.sampled_from(CASES['far']))} the {clause.object}",
        )
    rest = str(clause).removeprefix(f"the {clause.subject} is ")
    return task, Query((clause,)), draw(st.sampled_from(CASES["negated"])).format(subject=clause.subject, rest=rest)


@given(negations())
@settings(max_examples=400)
def test_no_reading_of_a_negated_condition_has_the_truth_of_the_affirmed_one(drawn):
    task, affirmed, text = drawn
    for query in readings(text, task):
        assert not implies(query, affirmed), (text, str(query))


@given(negations(), st.sampled_from(["and", "but", "while"]))
def test_a_negation_holds_for_its_own_part_of_a_conjunction(drawn, join):
    task, affirmed, text = drawn
    for query in readings(f"the {task.object_names[0]} is open {join} {text}", task):
        assert not implies(query, affirmed), (text, str(query))


CONDITIONS = [(task, *row) for task, rows in read_table("conditions.toml").items() for row in rows.items()]


@pytest.mark.parametrize(("task", "text", "query"), CONDITIONS)
def test_conditions_as_models_write_them(task, text, query):
    decoded = lw.decode_plan(f"- When {text}, the robot should ponder it.\n", task, "basic_md")
    steps = decoded.plan.steps if decoded.plan else ()
    assert [str(step.condition) for step in steps] == ([query] if query else [])
    assert any((f"is read as {query!r}" if query else text) in note.text for note in decoded.notes)


@given(st.sampled_from(TASKS), st.data())
def test_opposite_relations_are_not_confused(task, data):
    words = {"atop": "below", "beneath": "above", "underneath": "above"}
    words |= {"leftward of": "right of", "rear of": "in front of"}
    written = data.draw(st.sampled_from(sorted(words)))
    name = data.draw(st.sampled_from(lw.TASKS[task].object_names[1:]))
    query = nearest_query(f"the gripper is {written} the {name}", task).query
    assert all(clause.predicate != words[written] for clause in query.clauses)


@given(st.sampled_from(sorted(load_skills())), st.sampled_from(CASES["forbidden"]))
@example("close the gripper around the puck", "do not {}")
def test_a_forbidden_skill_is_in_no_plan(skill, pattern):
    text = pattern.format(skill)
    task = next(task for task in lw.TASKS.values() if load_skills()[skill].suits(task))
    assert instruction(text).text == ""
    assert StepMapper(task, None).skill(text)[0] is None
    assert nearest_skill(text)[1] == 0.0
    decoded = lw.decode_plan(f"- When the gripper is open, the robot should {text}.", task, "basic_md")
    assert decoded.plan is None
    assert decoded.notes
    if text.split()[0].isalpha():
        plan = lw.ConditionalPlan.from_pairs(task, [("the gripper is open", text)])
        report = explain_canonical(plan)
        assert report.read == ()
        assert len(report.left_out) == 1


@pytest.mark.parametrize("skill", CASES["away"])
def test_moving_away_is_not_read_as_moving_there(skill):
    plan = lw.ConditionalPlan.from_pairs("coffee-push", [("the gripper is near the mug", skill)])
    assert explain_canonical(plan).read == ()


def test_what_not_to_do_besides_is_left_out_and_named():
    skill = "place the gripper above the mug, but do not touch it"
    plan = lw.ConditionalPlan.from_pairs("coffee-push", [("the gripper is open", skill)])
    (step,) = explain_canonical(plan).read
    assert step.role.verb == "approach"
    assert explain_canonical(plan).notes()[0]["ignored"] == "but do not touch it"
    decoded = lw.decode_plan(f"- When the gripper is open, the robot should {skill}.", "coffee-push", "basic_md")
    assert decoded.scripted.steps[0].skill == "place the gripper above the mug"
    assert any("but do not touch it" in note.text for note in decoded.notes)


def test_misspelt_objects_are_matched():
    pairs = [
        ("the gripper is near the mug", "carry teh mug to the targt locaton"),
        ("the gripper is open", "close teh gripper aroud the mgu"),
    ]
    steps = explain_canonical(lw.ConditionalPlan.from_pairs("coffee-push", pairs)).read
    assert [(step.role.verb, step.role.moved, step.role.target) for step in steps] == [
        ("carry", "mug", GOAL),
        ("close", "robot's gripper", "mug rim"),
    ]


NEAR, FAR_AWAY = "the gripper is near the mug", "the gripper is not near the mug"
OPEN = "open the gripper"


@pytest.mark.parametrize(("skill", "words"), CASES["qualifiers"])
def test_a_qualifier_that_no_step_can_express_is_named(skill, words):
    decoded = lw.decode_plan(f"- When {NEAR}, the robot should {skill}.", "coffee-push", "basic_md")
    assert any(words in note.text for note in decoded.notes)


@pytest.mark.parametrize("frame", CASES["unknown"])
@pytest.mark.parametrize("verb", ["push", "pull", "lift"])
def test_an_action_in_an_unknown_frame_is_not_done(frame, verb):
    skill = frame.format(verb)
    decoded = lw.decode_plan(f"- When {NEAR}, the robot should {skill}.", "coffee-push", "basic_md")
    assert decoded.plan is None
    assert any("commands no action" in note.text for note in decoded.notes)
    report = explain_canonical(lw.ConditionalPlan.from_pairs("coffee-push", [("the gripper is open", skill)]))
    assert report.left_out == (skill,)


@pytest.mark.parametrize("text", CASES["prohibitions"])
@pytest.mark.parametrize("line", ["{}", "- {}", "**Warning:** {}", "2. {}"])
def test_a_prohibition_is_named_in_a_note(text, line):
    decoded = lw.decode_plan(f"1. If {FAR_AWAY}, {OPEN}.\n{line.format(text)}\n", "coffee-push")
    assert [step.skill for step in decoded.plan.steps] == [OPEN]
    assert any("lift" in note.text for note in decoded.notes)
    alone = lw.decode_plan(line.format(text), "coffee-push")
    assert alone.plan is None
    assert any("lift" in note.text for note in alone.notes)


@pytest.mark.parametrize("verb", ["stop", "cease", "quit"])
def test_a_skill_that_ends_an_action_is_left_out_with_a_note(verb):
    rules = f"- If {NEAR}, {verb} lifting the mug.\n- If {FAR_AWAY}, stop."
    code = f'def coffee_push(robot):\n    if check("{NEAR}"):\n        robot.{verb}_lifting("the mug")\n'
    for text, skills in ((rules, ["stop"]), (f"{code}    else:\n        robot.stop()\n", ["stop"])):
        decoded = lw.decode_plan(text, "coffee-push")
        assert [step.skill for step in decoded.plan.steps] == skills
        assert any(f"{verb} lifting the mug" in note.text for note in decoded.notes)


@pytest.mark.parametrize(
    "frame",
    ["start {}ing it", "keep on {}ing it", "remember to {} it", "go ahead and {} it", "use the gripper to {} it"],
)
def test_an_affirmed_action_is_read(frame):
    skill = frame.format("push").replace("it", "the mug")
    report = explain_canonical(lw.ConditionalPlan.from_pairs("coffee-push", [("the gripper is open", skill)]))
    assert [step.role.verb for step in report.read] == ["push"]


@pytest.mark.parametrize(
    "place", ["un-beside", "!above", "somewhere else than near", "barely on", "outside", "anti-near"]
)
def test_an_uncertain_place_has_no_script(place):
    assert StepMapper(lw.TASKS["push"], None).skill(f"move the puck {place} the target location")[0] is None


@pytest.mark.parametrize(("text", "wrong"), CASES["wrong"])
def test_a_condition_without_a_word_for_the_state_is_not_that_state(text, wrong):
    match = nearest_query(text, "push")
    assert match.least_score < 0.6 or wrong not in str(match.query)
