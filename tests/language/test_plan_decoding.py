"""decode_plan: any text becomes a plan with notes, or a reason; it raises no error, and nothing is executed."""

import json
import random
import tomllib
from pathlib import Path
from typing import NamedTuple

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
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
    """A row of answers.toml: an answer as models write it, and the expected reading."""

    task: str
    format: str
    text: str
    steps: list[list[str]]  # the conditions as queries, and the skills as they are written
    notes: list[str] = []  # parts of notes, each with its line
    reason: str = ""


ANSWERS = {
    name: Answer(**row)
    for name, row in tomllib.loads((Path(__file__).parent / "answers.toml").read_text("utf-8")).items()
}


def decoded(name):
    answer = ANSWERS[name]
    return lw.decode_plan(answer.text, answer.task, answer.format)


@pytest.mark.parametrize("name", ANSWERS)
def test_answers_as_models_write_them(name):
    answer, found = ANSWERS[name], decoded(name)
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


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("<think>\nFirst I thought:\n{}\nNo.</think>\n", ""),
        ("<Thinking>\n{}</think>\n", ""),
        ("{}\nNo.</think>\n", ""),
        ("[THINK]{}\nNo.[/THINK]", ""),
        ("<|channel|>analysis<|message|>{}<|end|><|start|>assistant<|channel|>final<|message|>", ""),
        ("<|channel|>analysis<|message|>{}\n<|channel|>final <|constrain|>json<|message|>", ""),
        ("<think>one</think>\n<think>{}</think>\n", ""),
        ("<think>Is </think> the end? <think>{}\n</think>\n", ""),
        ("{}\nSo be it. [/THINK]\n", ""),
        ('{}\nThat is #2, "push it".</think>\n', ""),
        ("", "\n<think>\n{}\n</think>\n"),
    ],
)
def test_thoughts_of_many_models(before, after):
    plans = lw.load_plans("MT10")
    draft, final = (lw.encode_plan(lw.ConditionalPlan("push", plans["push"].steps[:n]), "chain_py") for n in (3, 2))
    found = lw.decode_plan(f"{before.format(draft)}{final}{after.format(draft)}", "push", "chain_py")
    assert found.plan.steps == plans["push"].steps[:2]
    assert "the model's reasoning is left out" in str(found.notes[0])
    assert after or found.steps[0].line > before.count("\n") + draft.count("\n")


DRAFT, RULE = "If the gripper is above the puck, lift the puck.", "If the gripper is near the puck, close the gripper."


@pytest.mark.parametrize(
    "text",
    [
        f"A bad plan: {DRAFT}\n{RULE}",
        f"✗ {DRAFT}\n✓ {RULE}",
        f"Incorrect:\n- {DRAFT}\n\nMy plan:\n- {RULE}",
        f"> {DRAFT}\n\n{RULE}",
        f"<s>{DRAFT}</s>\n{RULE}",
        f"```diff\n- {DRAFT}\n+ {RULE}\n```",
        f"First version:\n```\n{DRAFT}\n```\nAnswer:\n```\n{RULE}\n```",
        f"```\n{DRAFT}\n```\nThis was wrong.\n```\n{RULE}\n```",
        f"1. {DRAFT}\n\nOops, this does not work. Let me try again.\n\n1. {RULE}",
        f"- {DRAFT}\n\nPlease ignore the above.\n- {RULE}",
        f"{DRAFT}\n\n**Revised plan**\n\n{RULE}",
        f"- {DRAFT}\n\nHere is the improved version.\n- {RULE}",
        f"# Rejected\n\n## Idea\n{DRAFT}\n\n# Plan\n{RULE}",
        f"{RULE}\n\n### Old rules\n\n{DRAFT}",
        f"Example:\n- {DRAFT}\n\nRules:\n- {RULE}",
        f'The prompt says: "{DRAFT}"\n\n- {RULE}',
        f"- {RULE}\n- Unlike “{DRAFT}” this is safe.",
        f'{RULE}\n"{DRAFT}" would be dangerous.',
    ],
)
def test_drafts_are_left_out_by_name(text):
    decoded = lw.decode_plan(text, "push")
    assert [step.skill for step in decoded.plan.steps] == ["close the gripper"]
    assert "lift the puck" in " ".join(map(str, decoded.notes))


@pytest.mark.parametrize("text", [f"> {RULE}", f"For example:\n```\n{RULE}\n```"])
def test_an_answer_that_is_only_a_draft_is_read(text):
    assert [step.skill for step in lw.decode_plan(text, "push").plan.steps] == ["close the gripper"]


@pytest.mark.parametrize(
    "text",
    [
        f'- "{DRAFT}"\n- "{RULE}"',
        f'Rule 1: "{DRAFT}"\nRule 2: "{RULE}"',
        f"{DRAFT}\n\nThis is correct.\n\n{RULE}",
        f"{DRAFT}\n\nThis does not work in the dark.\n\n{RULE}",
        f"{DRAFT}\n\nFinal plan summary:\n{RULE}",
        f"## Plan\n{DRAFT}\n\n## Better grip phase\n{RULE}",
        f"- {DRAFT}\n- {RULE}\n\nFinal answer: see above.",
    ],
)
def test_text_that_is_not_withdrawn_is_read(text):
    skills = [step.skill for step in lw.decode_plan(text, "push").plan.steps]
    assert skills == ["lift the puck", "close the gripper"]


@pytest.mark.parametrize(
    "text", ["\n" * 65_000, "```\n" * 16_000, '"if ' + "," * 60_000, "# old\n" * 10_000, "a " * 32_000]
)
def test_drafts_are_found_in_linear_time(text):
    with within(3):
        assert without_drafts(text, []) is not None


def test_items_of_a_list_in_html_are_rules():
    decoded = lw.decode_plan(f"<ul><li>{DRAFT}<li>{RULE}</ul>", "push")
    assert [step.skill for step in decoded.plan.steps] == ["lift the puck", "close the gripper"]


def test_a_second_condition_is_not_part_of_the_skill():
    decoded = lw.decode_plan(f"- When the gripper is open, if the sun shines, wave the hand.\n- {RULE}", "push")
    assert [step.skill for step in decoded.plan.steps] == ["close the gripper"]
    assert "sun" in " ".join(map(str, decoded.notes))


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
        for text in (
            json.dumps(row),
            f"<think>Or {{}}?</think>{json.dumps(row)}",
            f"```json\n{json.dumps(row)}\n```",
        ):
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


@pytest.mark.parametrize(
    ("condition", "query"),
    [
        ("the robot's gripper is holding the puck", f"{GRIPPER} around the puck"),
        ("the puck is at the goal", "the puck is near the target location"),
        ("the puck is not in the target area", "the puck is not near the target location"),
        ("the gripper is on top of the puck", f"{GRIPPER} above the puck"),
        ("the puck is on the table", "the puck is touching the table"),
        ("the puck is to the left of the gripper", "the puck is left of the robot's gripper"),
        ("the puck is next to the goal position", "the puck is near the target location"),
    ],
)
def test_conditions_in_models_words(condition, query):
    found = lw.decode_plan(f'if check("{condition}"):\n    robot.push("puck")', "push", "basic_py")
    assert str(found.plan.steps[0].condition) == query
    assert found.steps[0].condition_distance == 0.0
    assert f"is read as {query!r}" in str(found.notes[0])


@pytest.mark.parametrize(
    ("skill", "scripted"),
    [
        ('grab("puck")', "close the gripper around the puck"),
        ('put("gripper around puck")', "lower the gripper around the puck"),
        ('drop("gripper around the puck")', "lower the gripper around the puck"),
        ('put("gripper above puck")', "place the gripper above the puck"),
        ('place("puck at goal")', "move the puck to the target location"),
        ('slide("the puck to target")', "move the puck to the target location"),
    ],
)
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


WRAPPED = """
- If the gripper is not above the puck and the
gripper is open, then place the gripper above the
puck.
- Recite a poem about robots.
- Never, if the gripper is open, lift the puck.
- When the gripper is near the puck, close the gripper.
"""


def test_wrapped_lines_are_joined_and_lines_without_a_rule_are_named():
    decoded = lw.decode_plan(WRAPPED, "push")
    assert [step.skill for step in decoded.plan.steps] == ["place the gripper above the puck", "close the gripper"]
    notes = "\n".join(map(str, decoded.notes))
    assert "Recite a poem about robots" in notes
    assert "lift the puck" in notes


@pytest.mark.parametrize("key", ["never", "do_not", "avoid"])
def test_actions_under_keys_that_forbid_are_left_out_by_name(key):
    text = json.dumps({"rules": [{"when": "gripper open", "do": "close the gripper"}, {key: "lift the puck"}]})
    decoded = lw.decode_plan(text, "push")
    assert [step.skill for step in decoded.plan.steps] == ["close the gripper"]
    assert "lift the puck" in "\n".join(map(str, decoded.notes))
