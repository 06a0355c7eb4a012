"""Free-form steps: paraphrases are parsed like the shipped plans that they paraphrase."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from speed import within
from test_canonical import CASES, OWN, G, meanings, plan_of

import lw_torchrl as lw
from lw_torchrl.language.canonical import canonical_plan, explain_canonical
from lw_torchrl.language.objects import NamedObject
from lw_torchrl.language.plans import ConditionalPlan
from lw_torchrl.language.roles import ignored_words, mark_objects, simplify
from lw_torchrl.language.step_parser import parse_steps

PARAPHRASES = json.loads((Path(__file__).parent / "sayings.json").read_text("utf-8"))
"""Skills of 30 shipped plans, and ten paraphrases of each by three writers who saw neither rules nor plans."""


@pytest.mark.parametrize(("text", "simple"), CASES["simple"])
def test_free_form_steps_become_known_words(text, simple):
    assert simplify(mark_objects(text, lw.TASKS["coffee-pull"])) == simple.format(G=G)


@pytest.mark.parametrize("skills", ["own", "MT10"])
def test_the_words_of_shipped_plans_are_known(skills):
    for task, plan in lw.load_plans("MT50", skills=skills).items():
        for step in plan.steps:
            marked = mark_objects(step.skill, lw.TASKS[task])
            assert simplify(marked) == marked


@pytest.mark.parametrize("skills", ["own", "MT10"])
def test_shipped_plans_have_no_ignored_words(skills):
    for task, plan in lw.load_plans("MT50", skills=skills).items():
        assert not any(ignored_words(step.skill, lw.TASKS[task]) for step in plan.steps)


@given(
    st.sampled_from(sorted(OWN)), st.sampled_from(["four times", "twice", "like crazy", "until midnight"]), st.data()
)
def test_words_that_no_step_can_express_are_named_and_change_no_role(task, words, data):
    plan = OWN[task]
    step = data.draw(st.sampled_from(plan.steps))
    pairs = [(each.condition, f"{each.skill} {words}" if each is step else each.skill) for each in plan.steps]
    changed = ConditionalPlan.from_pairs(plan.definition, pairs)
    report = explain_canonical(changed)
    assert meanings(report.plan) == meanings(canonical_plan(plan))
    assert any(words.split()[-1] in row.get("ignored", "") for row in report.notes())


@pytest.mark.parametrize(
    ("text", "verb"), [("cloes the gripper", "close"), ("shovve the mug", "shove"), ("liftt it", "lift")]
)
def test_a_misspelt_verb_is_corrected(text, verb):
    assert mark_objects(text, lw.TASKS["coffee-push"]).startswith(f"{verb} ")


@pytest.mark.slow
def test_nine_of_ten_paraphrases_have_the_same_meaning():
    same, unread = [], 0
    for plan in OWN.values():
        expected = meanings(canonical_plan(plan))
        for step in plan.steps:
            for text in PARAPHRASES.get(step.skill, ()):
                pairs = [(each.condition, text if each is step else each.skill) for each in plan.steps]
                report = explain_canonical(ConditionalPlan.from_pairs(plan.definition, pairs))
                same.append(meanings(report.plan) == expected)
                unread += bool(report.left_out)
    assert len(same) > 1100
    assert sum(same) >= 0.9 * len(same)
    assert unread < 0.02 * len(same)


@pytest.mark.parametrize(("task", "steps", "last"), CASES["last"])
def test_the_meaning_of_the_last_step(task, steps, last):
    *_, step = parse_steps(plan_of(task, *steps))
    assert (step.moved, step.verb, step.target, step.direction or "")[: len(last)] == tuple(last)


@pytest.mark.parametrize("text", ["go over the wall", "move the gripper around the wall", "cross over the wall"])
def test_the_way_over_an_obstacle_leads_to_the_point_behind_it(text):
    steps = [("gripper is not behind the wall and gripper is not forward aligned with the button", text)]
    steps.append(("gripper is behind the wall and gripper is not near the button", "come down in front of the button"))
    steps += [("gripper is forward aligned with the button", "push it in"), ("gripper is open", "push the wall away")]
    report = explain_canonical(plan_of("button-press-wall", *steps))
    assert (report.source, report.left_out) == ("plan", ("push the wall away",))
    roles = [(step.role.verb, step.role.target) for step in report.plan.steps]
    assert roles == [("approach", "button center"), ("beside", "button center"), ("push", "button center")]


@pytest.mark.parametrize(
    ("task", "skill"),
    [("door-lock", "unlock the door"), ("door-unlock", "lock the door"), ("drawer-close", "unshut it")],
)
def test_a_step_that_undoes_the_task_has_no_meaning(task, skill):
    plan = ConditionalPlan.from_pairs(task, [("gripper is open", skill)])
    assert parse_steps(plan) == (None,)


def test_an_object_may_be_called_hand():
    objects = (*lw.TASKS["push"].objects[:1], NamedObject("hand", (4, 5, 6)))
    task = replace(lw.TASKS["push"], name="shake", objects=objects)
    assert mark_objects("take the hand with your fingers", task) == f"take <hand> with your <{G}>"


@given(st.lists(st.sampled_from(["go", "to", "the mug", "it", "until", "is", "between", "on", "a", "keep", "lying"])))
def test_any_text_is_rewritten_without_new_objects(words):
    marked = mark_objects(" ".join(words), lw.TASKS["coffee-pull"])
    assert simplify(marked).count("<mug>") <= marked.count("<mug>")


def test_a_long_text_is_rewritten_in_time():
    with within(5):
        for text in ("go " + "to " * 80_000, "line <mug> " + "a " * 80_000, "until " * 40_000):
            simplify(text)
