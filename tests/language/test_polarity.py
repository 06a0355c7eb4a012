"""No reading of a sentence means the opposite: negations and opposites are kept, or left out with a note."""

import json

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import lw_torchrl as lw
from lw_torchrl.language.canonical import explain_canonical
from lw_torchrl.language.expressions import evaluate, leaves
from lw_torchrl.language.nearest import StepMapper, nearest_query, nearest_skill
from lw_torchrl.language.polarity import instruction
from lw_torchrl.language.queries import Query, base_clauses, parse_query
from lw_torchrl.language.relations import PREDICATES
from lw_torchrl.language.skills import load_skills
from lw_torchrl.language.tasks import GOAL

TASKS = ("push", "drawer-open", "stick-pull", "reach")
# Each negates the sentence "the SUBJECT is PREDICATE".
NEGATED = (
    "the {subject} isn't {rest}",
    "the {subject} is no longer {rest}",
    "the {subject} is never {rest}",
    "the {subject} cannot be {rest}",
    "the {subject} should not be {rest}",
    "the {subject} is not yet {rest}",
    "the {subject} is anything but {rest}",
    "the {subject} is other than {rest}",
    "the {subject} fails to be {rest}",
    "the {subject} avoids being {rest}",
    "the {subject} is hardly {rest}",
    "the {subject} is neither {rest} nor so",
    "it is not the case that the {subject} is {rest}",
    "it is false that the {subject} is {rest}",
    "unless the {subject} is {rest}",
    "do not let the {subject} be {rest}",
    "without the {subject} being {rest}",
    "except when the {subject} is {rest}",
    "no part of the {subject} is {rest}",
)
FAR = (
    "far from",
    "away from",
    "clear of",
    "out of reach of",
    "well away from",
    "far away from",
    "nowhere near",
    "outside",
)


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
        return task, Query((clause,)), f"the {clause.subject} is {draw(st.sampled_from(FAR))} the {clause.object}"
    rest = str(clause).removeprefix(f"the {clause.subject} is ")
    return task, Query((clause,)), draw(st.sampled_from(NEGATED)).format(subject=clause.subject, rest=rest)


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


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("the gripper is far from the drawer handle", "the robot's gripper is not near the drawer handle"),
        ("the gripper is not far from the drawer handle", "the robot's gripper is near the drawer handle"),
        ("the gripper is no longer open", "the robot's gripper is not open"),
        ("the gripper is open without being near the drawer handle",
         "the robot's gripper is open and the robot's gripper is not near the drawer handle"),
        ("the gripper is open except when near the drawer handle",
         "the robot's gripper is open and the robot's gripper is not near the drawer handle"),
        ("the gripper is not only open but near the drawer handle",
         "the robot's gripper is open and the robot's gripper is near the drawer handle"),
        ("the gripper isn`t open", "the robot's gripper is not open"),
        ("the gripper is nott open", "the robot's gripper is not open"),
        ("the gripper is notopen", "the robot's gripper is not open"),
        ("gripper_not_open", "the robot's gripper is not open"),
        ("isGripperNotOpen", "the robot's gripper is not open"),
        ("¬ gripper open", "the robot's gripper is not open"),
    ],
)  # fmt: skip
def test_negations_are_read(text, expected):
    assert str(nearest_query(text, "drawer-open").query) == str(parse_query(expected, "drawer-open"))


@pytest.mark.parametrize(
    "text",
    [
        "the gripper avoids the puck",
        "the gripper fails to reach the puck",
        "nothing is open",
        "the negation of the gripper being open",
        "till the gripper is open",
        "the gripper remains to be opened",
    ],
)
def test_a_negation_of_unknown_effect_is_left_out_with_a_note(text):
    decoded = lw.decode_plan(f"- When {text}, the robot should open the gripper.", "push", "basic_md")
    assert decoded.plan is None
    assert any(text in note.text for note in decoded.notes)


@given(st.sampled_from(TASKS), st.data())
def test_opposite_relations_are_not_confused(task, data):
    words = {
        "atop": "below",
        "beneath": "above",
        "underneath": "above",
        "leftward of": "right of",
        "rear of": "in front of",
    }
    written = data.draw(st.sampled_from(sorted(words)))
    name = data.draw(st.sampled_from(lw.TASKS[task].object_names[1:]))
    query = nearest_query(f"the gripper is {written} the {name}", task).query
    assert all(clause.predicate != words[written] for clause in query.clauses)


FORBIDDEN = (
    "do not {}", "don't {}", "never {}", "not {}", "must not {}", "avoid letting anything {}", "refrain from it: {}",
    "anything but {}", "neither {} nor wait", "no longer {}", "make sure not to {}", "do not let it {}",
    "under no circumstances {}",
)  # fmt: skip


@given(st.sampled_from(sorted(load_skills())), st.sampled_from(FORBIDDEN))
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


@pytest.mark.parametrize(
    "skill",
    ["move the gripper away from the mug", "stay clear of the mug", "keep the gripper off the mug",
     "stop pushing the mug",
     "move the mug away from the target location", "back off from the mug", "raise the gripper unless it is open"],
)  # fmt: skip
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


def test_an_exception_becomes_a_part_of_the_condition():
    skill = "close the gripper around the mug unless the gripper is closed"
    text = f"- When the gripper is near the mug, the robot should {skill}."
    (step,) = lw.decode_plan(text, "coffee-push", "basic_md").plan.steps
    expected = "the gripper is near the mug and the gripper is not closed"
    assert step.condition == parse_query(expected, "coffee-push")
    assert step.skill == "close the gripper around the mug"
    unread = text.replace("the gripper is closed", "the moon is full")
    decoded = lw.decode_plan(unread, "coffee-push", "basic_md")
    assert decoded.plan is None
    assert "the moon is full" in decoded.notes[-1].text


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


@pytest.mark.parametrize(
    ("skill", "words"),
    [
        ("carry the mug beyond the target location", "beyond"),
        ("push the mug nearly to the target location", "nearly"),
        ("carry the mug three inches behind the target location", "three inches"),
        ("carry the mug to the target location, but stop before it", "but stop"),
    ],
)
def test_a_qualifier_that_no_step_can_express_is_named(skill, words):
    decoded = lw.decode_plan(
        f"- When the gripper is near the mug, the robot should {skill}.", "coffee-push", "basic_md"
    )
    assert any(words in note.text for note in decoded.notes)


@pytest.mark.parametrize(
    "frame",
    ["postpone {}ing the mug to the target location", "it is no use to {} the mug", "dream about {}ing the mug",
     "hinder the mug from {}ing", "{}ing the mug is out of the question", "cancel the {} of the mug",
     "hesitate to {} the mug to the target location"],
)  # fmt: skip
@pytest.mark.parametrize("verb", ["push", "pull", "lift"])
def test_an_action_in_an_unknown_frame_is_not_done(frame, verb):
    skill = frame.format(verb)
    decoded = lw.decode_plan(
        f"- When the gripper is near the mug, the robot should {skill}.", "coffee-push", "basic_md"
    )
    assert decoded.plan is None
    assert any("commands no action" in note.text for note in decoded.notes)
    report = explain_canonical(lw.ConditionalPlan.from_pairs("coffee-push", [("the gripper is open", skill)]))
    assert report.left_out == (skill,)


@pytest.mark.parametrize(
    "text",
    [
        "Avoid lifting the mug while the gripper is near the mug.",
        "When the gripper is near the mug, the robot mustn't lift the mug.",
        "When the gripper is near the mug, it is prohibited to lift the mug.",
        "When the gripper is near the mug, the mug can't be lifted.",
        "Caution: lifting the mug is not allowed.",
        "Never, ever lift the mug.",
        "Do not, under any circumstances, lift the mug.",
        "Nobody may lift the mug.",
        "Do not let the robot lift the mug.",
    ],
)
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


@pytest.mark.parametrize("test", ["not robot.lift('the mug')", "robot.lift('the mug')"])
def test_an_action_in_an_assertion_is_left_out_with_a_note(test):
    code = (
        f'def coffee_push(robot):\n    if check("{NEAR}"):\n        assert {test}\n        robot.open("the gripper")\n'
    )
    decoded = lw.decode_plan(code, "coffee-push")
    (step,) = decoded.plan.steps
    assert (step.condition, step.skill) == (parse_query(NEAR, "coffee-push"), OPEN)
    assert any("lift" in note.text for note in decoded.notes)


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


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("it is 8 o'clock", "closed"),
        ("the puck is floating over the table", "touching the table"),
        ("the puck is not near the gripper not above it", "is above"),
        ("it is doubtful that the gripper is near the puck", "is near"),
    ],
)
def test_a_condition_without_a_word_for_the_state_is_not_that_state(text, wrong):
    match = nearest_query(text, "push")
    assert match.least_score < 0.6 or wrong not in str(match.query)


def read_condition(text, task):
    """Return the query as which a step's condition is read; None if the step is left out, with its condition named."""
    decoded = lw.decode_plan(f"- When {text}, the robot should ponder it.\n", task, "basic_md")
    if decoded.plan is None:
        assert any(text in note.text for note in decoded.notes)
        return None
    return decoded.plan.steps[0].condition


@pytest.mark.parametrize(
    ("text", "task"),
    [
        ("the dog is near the puck", "push"),
        ("the operator's hand is near the puck", "push"),
        ("the human hand is near the puck", "push"),
        ("the parked car is near the puck", "push"),
        ("the gripper is above the lamp", "push"),
        ("the gripper is close to the wall", "push"),
        ("the gripper is near the other puck", "push"),
        ("the gripper is near the corner", "push"),
        ("the gripper is above the table", "push"),
        ("the puck is held by the visitor", "push"),
        ("the gripper is near the puck and the radio is on", "push"),
        ("the gripper is near the door handle", "drawer-open"),
        ("the peg is near the gripper", "window-open"),
    ],
)
def test_an_object_that_the_task_lacks_is_not_another_object(text, task):
    assert read_condition(text, task) is None


@pytest.mark.parametrize(
    ("text", "task", "expected"),
    [
        ("the griper is near the puk", "push", "the gripper is near the puck"),
        ("the robot's left finger is above the blue puck", "push", None),
        ("the robotic arm is above the blue puck", "push", "the gripper is above the puck"),
        ("the hand is near the cup", "coffee-push", "the gripper is near the mug"),
        ("the gripper is near the rim of the cup", "coffee-push", "the gripper is near the mug"),
        ("the gripper is above the drawer", "drawer-open", "the gripper is above the drawer handle"),
        ("the gripper is near the drawer handle", "handle-press-side", "the gripper is near the handle"),
        ("the gripper is near the knob", "door-open", "the gripper is near the door handle"),
        ("the gripper is near the goal", "shelf-place", "the gripper is near the shelf"),
        ("the robot is above the puck", "push", "the gripper is above the puck"),
        ("the gripper is near the puck and the target location", "push",
         "the gripper is near the puck and near the target location"),
    ],
)  # fmt: skip
def test_an_object_is_read_by_its_other_names(text, task, expected):
    assert read_condition(text, task) == (None if expected is None else parse_query(expected, task))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("the gripper is within 3 centimetres of the puck", "the gripper is near the puck"),
        ("the gripper is not within reach of the puck", "the gripper is not near the puck"),
        ("the gripper is near the right corner of the puck", "the gripper is near the puck"),
        ("the gripper is above the front of the puck", "the gripper is above the puck"),
        ("the gripper is at the right-hand side of the puck", "the gripper is right of the puck"),
        ("the gripper is to the side of the puck", "the gripper is left of the puck or right of the puck"),
        ("the puck is not currently held", "the gripper is not around the puck"),
        ("the puck is being gripped by the hand", "the gripper is around the puck"),
        ("the puck is ungrasped", "the gripper is not around the puck"),
        ("the gripper is open and/or near the puck", "the gripper is open or near the puck"),
    ],
)
def test_a_relation_is_read_as_one_with_the_same_meaning(text, expected):
    assert read_condition(text, "push") == parse_query(expected, "push")


@pytest.mark.parametrize(
    "text",
    [
        "the puck is lifted",
        "the puck is light",
        "the gripper is facing the puck",
        "the gripper is parallel to the puck",
        "the gripper is pressing the puck",
        "the gripper is partially closed",
        "the gripper is open above the puck",
        "the gripper is holding the puck near the target location",
    ],
)
def test_no_relation_is_read_that_the_text_does_not_state(text):
    assert read_condition(text, "push") is None


def test_two_subjects_share_a_predicate():
    query = nearest_query("the gripper and the puck are above the target location", "push").query
    assert query == parse_query(
        "the gripper is above the target location and the puck is above it".replace(" it", " the target location"),
        "push",
    )


@pytest.mark.parametrize(
    "condition",
    [
        'int(check("gripper near mug")) != 1',
        'check("gripper near mug", invert=True)',
        'check("gripper near mug", expect=False)',
        'is_not("gripper near mug")',
        'bool(check("gripper near mug")) == 0',
        '~check("gripper near mug")',
        '1 - holds("gripper near mug")',
        'True ^ check("gripper near mug")',
        'query_false("gripper near mug")',
        'is_false("gripper near mug")',
        'check("gripper near mug") < 1',
    ],
)
def test_negations_in_code_are_kept(condition):
    code = f'def coffee_push(robot):\n    if {condition}:\n        robot.open("the gripper")\n'
    (step,) = lw.decode_plan(code, "coffee-push").plan.steps
    assert step.condition == parse_query("the gripper is not near the mug", "coffee-push")


@pytest.mark.parametrize(
    "body",
    [
        'robot.open("the gripper", unless="gripper near mug")',
        'with unless(check("gripper near mug")):\n        robot.open("the gripper")',
        'assert not check("gripper near mug")\n    robot.open("the gripper")',
        'if check("gripper near mug"):\n        raise RuntimeError\n    robot.open("the gripper")',
    ],
)
def test_exceptions_in_code_are_kept(body):
    (step,) = lw.decode_plan(f"def coffee_push(robot):\n    {body}\n", "coffee-push").plan.steps
    assert step.condition == parse_query("the gripper is not near the mug", "coffee-push")


NEAR, FAR_AWAY = "the gripper is near the mug", "the gripper is not near the mug"
CLOSE, OPEN = "close the gripper around the mug", "open the gripper"


@pytest.mark.parametrize(
    "text",
    [
        f"<table><tr><th>when</th><th>do</th></tr><tr><td>{NEAR}</td><td>{CLOSE}</td></tr>"
        f"<tr><td>{FAR_AWAY}</td><td>{OPEN}</td></tr></table>",
        f"* - {NEAR}\n  - {CLOSE}\n* - {FAR_AWAY}\n  - {OPEN}\n",
        f"If {NEAR}, then {CLOSE}, else {OPEN}.",
        f"IF {NEAR}\nTHEN {CLOSE}\nELSE {OPEN}\n",
        f"a) If {NEAR}, {CLOSE}. b) If {FAR_AWAY}, {OPEN}.",
        f"If {NEAR}, {CLOSE} | If {FAR_AWAY}, {OPEN}",
        f"① When {NEAR}, {CLOSE}.\n② When {FAR_AWAY}, {OPEN}.",
    ],
)
def test_rules_in_other_shapes_are_read(text):
    steps = lw.decode_plan(text, "coffee-push").plan.steps
    wanted = [(parse_query(query, "coffee-push"), skill) for query, skill in ((NEAR, CLOSE), (FAR_AWAY, OPEN))]
    assert [(step.condition, step.skill.lower()) for step in steps] == wanted


def test_lines_that_cannot_be_read_are_named():
    decoded = lw.decode_plan(f'when,do\n"{NEAR}","{CLOSE}"\n', "coffee-push")
    assert decoded.plan is not None or any(CLOSE in note.text for note in decoded.notes)


@pytest.mark.parametrize(
    "rule",
    [
        {"condition": "gripper near mug", "inverted": True, "action": OPEN},
        {"if": "gripper near mug", "is": False, "then": OPEN},
        {"if": {"nor": ["gripper near mug"]}, "then": OPEN},
        {"if": {"nand": ["gripper near mug"]}, "then": OPEN},
        {"if": {"!": "gripper near mug"}, "then": OPEN},
        {"except_if": "gripper near mug", "then": OPEN},
        {"gripper is near the mug": False, "do": OPEN},
        {"if": {"$not": "gripper near mug"}, "then": OPEN},
        {"if": {"is_false": "gripper near mug"}, "then": OPEN},
        {"if": {"type": "inverter_decorator", "child": "gripper near mug"}, "then": OPEN},
        {"if": {"all_false": ["gripper near mug"]}, "then": OPEN},
    ],
)
def test_negations_in_json_are_kept(rule):
    (step,) = lw.decode_plan(json.dumps({"rules": [rule]}), "coffee-push").plan.steps
    assert step.condition == parse_query("the gripper is not near the mug", "coffee-push")


@pytest.mark.parametrize("flag", [{"disabled": True}, {"enabled": False}])
def test_disabled_rules_are_left_out_with_a_note(flag):
    rules = [{"if": FAR_AWAY, "then": OPEN, **flag}, {"if": NEAR, "then": CLOSE}]
    decoded = lw.decode_plan(json.dumps(rules), "coffee-push")
    assert [step.skill for step in decoded.plan.steps] == [CLOSE]
    assert any("disabled" in note.text for note in decoded.notes)


@pytest.mark.parametrize("struck", ["~~If {}, {}.~~", "<del>If {}, {}.</del>"])
def test_text_that_is_struck_out_is_left_out_with_a_note(struck):
    decoded = lw.decode_plan(f"{struck.format(FAR_AWAY, OPEN)}\nIf {NEAR}, {CLOSE}.\n", "coffee-push")
    assert [step.skill for step in decoded.plan.steps] == [CLOSE]
    assert any("left out" in note.text for note in decoded.notes)


@pytest.mark.parametrize(
    "text",
    [
        json.dumps([["my cat is asleep", OPEN], [NEAR, CLOSE]]),
        json.dumps({"my cat is asleep": OPEN, NEAR: CLOSE}),
        f"- [my cat is asleep, {OPEN}]\n- [{NEAR}, {CLOSE}]\n",
    ],
)
def test_a_pair_whose_condition_is_not_understood_is_named(text):
    decoded = lw.decode_plan(text, "coffee-push")
    assert [step.skill for step in decoded.plan.steps] == [CLOSE]
    assert any("cat" in note.text for note in decoded.notes)


def test_drafts_under_a_heading_of_thoughts_are_left_out():
    text = f"[[ ## reasoning ## ]]\nIf {FAR_AWAY}, {OPEN}.\n[[ ## answer ## ]]\nIf {NEAR}, {CLOSE}.\n"
    assert [step.skill for step in lw.decode_plan(text, "coffee-push").plan.steps] == [CLOSE]
