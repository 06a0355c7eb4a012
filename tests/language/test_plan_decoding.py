"""decode_plan: any text becomes a plan with notes, or a reason; it raises no error, and nothing is executed."""

import json
import random
from typing import NamedTuple

import pytest
from cases import read_cases
from hypothesis import example, given, settings
from hypothesis import strategies as st
from plan_texts import read_table
from speed import within

import lw_torchrl as lw
from benchmarks.decoding import mutated
from lw_torchrl.language.drafts import without_drafts
from lw_torchrl.language.formats import PLAN_FORMATS
from lw_torchrl.language.nearest import StepMapper
from lw_torchrl.language.plan_decoding import decode_as, without_thoughts
from lw_torchrl.language.skills import ScriptedSkill
from lw_torchrl.planners.prompts import read_structured, write_structured

GRIPPER = "the robot's gripper is"
formats = st.sampled_from(list(lw.PLAN_FORMATS))


class Answer(NamedTuple):
    """A text as models write it, and the expected plan and notes."""

    task: str
    text: str
    steps: list[list[str]]  # the conditions as queries, and the skills as they are written
    format: str | None = None
    notes: list[str] = []  # parts of notes, each with its line
    reason: str = ""


def answers(file):
    """Return the answers of a table in data by name; each text of a group of texts is an answer."""
    found = {}
    for name, row in read_table(file).items():
        texts = row.pop("texts", None)
        found |= (
            {name: Answer(**row)}
            if texts is None
            else {f"{name} {number}": Answer(text=text, **row) for number, text in enumerate(texts, 1)}
        )
    return found


ANSWERS = answers("answers.toml")
TEXTS = {**ANSWERS, **answers("programs.toml"), **answers("rules.toml")}


def decoded(name):
    answer = TEXTS[name]
    return lw.decode_plan(answer.text, answer.task, answer.format)


@pytest.mark.parametrize("name", TEXTS)
def test_answers_as_models_write_them(name):
    answer, found = TEXTS[name], decoded(name)
    steps = found.plan.steps if found.plan else ()
    assert [[str(step.condition), step.skill] for step in steps] == answer.steps
    assert answer.reason in found.reason
    assert bool(found.reason) == (found.plan is None) == (not answer.steps)
    notes = [str(note) for note in found.notes]
    assert all(any(part in note for note in notes) for part in answer.notes), notes
    lines = answer.text.splitlines()
    assert [note.line for note in found.notes] == sorted(note.line for note in found.notes)
    assert all(1 <= note.line <= len(lines) for note in found.notes)
    assert sum(not step.dropped for step in found.steps) == len(answer.steps)


def test_a_step_has_its_written_words_and_how_they_were_read():
    kept, dropped = decoded("words outside the language").steps
    assert (kept.line, dropped.line) == (1, 3)
    assert kept.written_condition == "the robot's gripper is holding onto the puck and the puk is at the goal"
    assert kept.written_skill == "release the puck"
    assert str(kept.condition) == f"{GRIPPER} around the puck and the puck is near the target location"
    assert 0.0 < kept.condition_distance <= 0.4 < dropped.condition_distance <= 1.0
    assert kept.dropped == ""
    assert dropped.condition is None
    assert "green cheese" in dropped.dropped


@pytest.mark.parametrize("tag", ["<think>", "<|begin_of_thought|>", "<|START_THINKING|>"])
def test_thoughts_without_an_answer_are_not_a_plan(tag):
    draft = lw.encode_plan(lw.load_plans("MT10")["push"], "chain_py")
    found = lw.decode_plan(f"Well.\n{tag}\n{draft}", "push", "chain_py")
    assert found.plan is None
    assert "no steps" in found.reason
    assert [str(note) for note in found.notes][1:] == [
        "line 2: the model's reasoning is left out (there is no end tag)"
    ]


@pytest.mark.parametrize(("before", "after"), read_cases("language/values.toml")["thoughts"])
def test_thoughts_of_many_models(before, after):
    plans = lw.load_plans("MT10")
    draft, final = (lw.encode_plan(lw.ConditionalPlan("push", plans["push"].steps[:n]), "chain_py") for n in (3, 2))
    found = lw.decode_plan(f"{before.format(draft)}{final}{after.format(draft)}", "push", "chain_py")
    assert found.plan.steps == plans["push"].steps[:2]
    assert "the model's reasoning is left out" in str(found.notes[0])
    assert after or found.steps[0].line > before.count("\n") + draft.count("\n")


@pytest.mark.parametrize(
    "text", ["\n" * 65_000, "```\n" * 16_000, '"if ' + "," * 60_000, "# old\n" * 10_000, "a " * 32_000]
)
def test_drafts_are_found_in_linear_time(text):
    with within(3):
        assert without_drafts(text, []) is not None


@pytest.mark.parametrize("tag", ["</think>", "# </think>", "# <think>", "# done </think>", "# [/THINK]"])
@pytest.mark.parametrize("place", [0, 3, 6, -1])
def test_a_tag_in_a_plan_removes_no_step(tag, place):
    plan = lw.load_plans("MT10")["push"]
    lines = lw.encode_plan(plan, "basic_py").splitlines()
    if tag == "</think>":
        lines[place] += f"  # {tag}"
    else:
        lines.insert(place if place >= 0 else len(lines), f"    {tag}")
    assert lw.decode_plan("\n".join(lines), "push", "basic_py").plan == plan


def test_tags_in_json_are_ordinary_words():
    plan = lw.load_plans("MT10")["push"]
    for tag in ("</think>", "<think>", "[THINK] x [/THINK]"):
        row = json.loads(write_structured(plan, PLAN_FORMATS["chain_py"].style))
        row["steps"][2]["because"] = f"Because. {tag}"
        for text in (json.dumps(row), f"<think>Or {{}}?</think>{json.dumps(row)}", f"```json\n{json.dumps(row)}\n```"):
            found = decode_as(text, read_structured, StepMapper(lw.TASKS["push"], None))
            assert found.plan == plan


@pytest.mark.parametrize(
    "tag", ["<think>", "</think>", "<think></think>", "<|channel|>final", "</think>\n", "# </think>"]
)
def test_many_tags_take_little_time(tag):
    with within(5):
        without_thoughts(tag * 50_000, [])


def test_a_text_in_the_query_language_has_no_distance_and_no_note():
    plan = lw.load_plans("MT50")["stick-pull"]
    found = lw.decode_plan(lw.encode_plan(plan, "goal_md"), "stick-pull", "goal_md")
    assert found.notes == ()
    assert found.scripted == found.plan == plan
    assert {(s.condition_distance, s.skill_distance, s.goal_distance) for s in found.steps} == {(0.0, 0.0, 0.0)}
    assert tuple(step.goal for step in found.steps) == plan.goals


def test_goals_are_mapped_to_near_queries():
    named, nameless = decoded("states to reach, named by the steps"), decoded("states to reach, without names")
    assert [str(goal) for goal in named.plan.goals] == [
        f"{GRIPPER} above the puck and {GRIPPER} open",
        f"{GRIPPER} near the puck and {GRIPPER} closed",
    ]
    assert str(nameless.steps[1].goal) == f"{GRIPPER} near the puck and {GRIPPER} closed"
    assert nameless.steps[2].written_goal == "peace is reached everywhere on earth"
    assert nameless.steps[2].goal is None
    assert nameless.steps[2].goal_distance > 0.4


def test_the_scripted_plan_has_the_task_s_nearest_skills():
    text = """    if check("the gripper is not above the mug"):
        robot.put("gripper above the mug")
    if check("the gripper is above the mug"):
        robot.grab("mug handle")
    if check("the gripper is closed"):
        robot.push("mug to goal")
    if check("the gripper is open"):
        robot.xyzzy("qqq")
"""
    found = lw.decode_plan(text, "coffee-push", "basic_py")
    assert [step.skill for step in found.scripted.steps] == [
        "place the gripper above the mug",
        "close the gripper around the mug",
        "move the mug to the target location",
    ]
    assert [step.skill for step in found.plan.steps][1] == "grab the mug handle"
    assert found.steps[3].scripted is None
    assert any("no scripted skill is near enough to 'xyzzy qqq'" in note.text for note in found.notes)
    lw.ScriptedSkillActor(lw.Plans([found.scripted]))


@pytest.mark.parametrize(("skill", "scripted"), read_cases("language/steps.toml")["scripted"])
def test_skills_in_models_words(skill, scripted):
    found = lw.decode_plan(f'if check("gripper open"):\n    robot.{skill}', "push", "basic_py")
    assert found.scripted.steps[0].skill == scripted


def test_custom_skills():
    mine = {"hover over the puck": ScriptedSkill("hover over the puck", "puck")}
    text = '    if check("gripper open"):\n        robot.hover("above puck")'
    found = lw.decode_plan(text, "push", "basic_py", skills=mine)
    assert found.scripted.steps[0].skill == "hover over the puck"
    none = lw.decode_plan(text, "push", "basic_py", skills={})
    assert (none.scripted, none.plan.steps[0].skill) == (None, "hover above the puck")


def test_steps_without_a_near_query_are_left_out():
    text = '    if check("the gripper is abov the puk"):\n        robot.plac("gripper abov puck")\n'
    text += '    if check("gripper open"):\n        robot.xyz("x y z x y z x y z x y z")\n'
    text += '    if check("it is Tuesday"):\n        robot.place("gripper above puck")'
    found = lw.decode_plan(text, "push", "basic_py")
    assert [str(step.condition) for step in found.plan.steps] == [f"{GRIPPER} above the puck", f"{GRIPPER} open"]
    assert [step.skill for step in found.scripted.steps] == ["place the gripper above the puck"]
    assert 0 < found.steps[0].condition_distance < 0.4 < found.steps[2].condition_distance


def test_a_custom_task(tmp_path):
    (tmp_path / "tasks.toml").write_text('[stack]\ndescription = "Stack it."\nobjects.brick = "obs[4:7]"\n')
    tasks = lw.load_tasks(tmp_path / "tasks.toml")
    text = 'def stack(robot):\n  if check("gripper not near brick"):\n    robot.reach("brick")'
    for task in ("stack", tasks["stack"]):
        found = lw.decode_plan(text, task, "basic_py", tasks=tasks)
        assert found.plan.steps[0].skill == "reach the brick"
        assert found.plan.definition == tasks["stack"]


LINES = [line for answer in ANSWERS.values() for line in answer.text.splitlines()]
any_text = st.text(st.characters()) | st.lists(st.sampled_from(LINES) | st.text(max_size=20), max_size=12).map(
    "\n".join
)


@example("    if check(", "basic_py")
@example('if check("\\"', "basic_py")
@example("def", "goal_py")
@example("robot.move_gripper()", "goal_py")
@example('if check("gripper open"):\n robot.move_gripper()', "goal_py")
@example("- When , the robot should .", "basic_md")
@example("- When x, move the robot's gripper until .", "goal_md")
@example("Steps:  1.", "goal_md")
@example("\ud800 if \x00", "basic_py_md")
@settings(max_examples=120, deadline=None)
@given(any_text, formats)
def test_any_text_is_a_plan_or_a_reason(text, format):
    found = lw.decode_plan(text, "push", format)
    assert (found.plan is None) == bool(found.reason)
    assert len(found.reason) < 1000
    if found.plan:
        assert lw.decode_plan(lw.encode_plan(found.plan, format), "push", format).plan.steps[0].skill


def test_a_text_is_never_executed(tmp_path):
    mark = tmp_path / "executed"
    attack = f"__import__('pathlib').Path({str(mark)!r}).touch()"
    for format in lw.PLAN_FORMATS:
        for text in (
            attack,
            f'    if check(f"{{{attack}}}"):\n        robot.push("puck")',
            f'    if check("gripper open"):\n        robot.push({attack})\n        {attack}',
            f'@{attack}\ndef push(robot={attack}):\n    if check("gripper open"):\n        robot.x(""); {attack}',
            f"- When gripper open, the robot should {attack}.",
        ):
            lw.decode_plan(text, "push", format)
    assert not mark.exists()


def test_mutated_answers_raise_nothing_and_take_little_time():
    texts, draw = [answer.text for answer in ANSWERS.values()], random.Random(0)
    for answer in ANSWERS.values():
        lw.decode_plan(answer.text, answer.task, answer.format)
    with within(15):
        for _ in range(500):
            answer = draw.choice(list(ANSWERS.values()))
            found = lw.decode_plan(mutated(draw, answer.text, texts), answer.task, answer.format)
            assert (found.plan is None) == bool(found.reason)


@pytest.mark.parametrize(
    "text",
    [
        "x" * 10**6,
        '"' * 20_000,
        '\\"' * 20_000,
        "(" * 20_000,
        'if check("' * 5_000,
        " " * 50_000 + "if",
        "- When a, " * 5_000,
        "</a>" * 10_000,
        "1. " * 10_000,
        "\\\n" * 30_000,
        "when a the robot should b\n" * 2_500,
        "\n".join(f'if check("a{k} b"):\n robot.x("c")' for k in range(2_000)),
        "\n".join(f"{' ' * k}if check('open'):" for k in range(300)),
    ],
)
@pytest.mark.parametrize("format", ["goal_py", "goal_md"])
def test_long_texts_take_linear_time(text, format):
    with within(12):  # 3 s on a quiet machine; a quadratic reader takes far longer
        lw.decode_plan(text, "stick-pull", format)


def test_steps_beyond_the_limit_are_left_out():
    found = lw.decode_plan("if check('gripper open'):\n robot.a()\n" * 1_500, "push", "basic_py")
    assert len(found.plan.steps) == len(found.steps) == 1_000
    assert "line 2001: the plan has more than 1000 steps; 500 are left out" in map(str, found.notes)
