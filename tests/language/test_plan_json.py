"""Plans as JSON with their tasks, and their fingerprint."""

import json
import random
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import lw_torchrl as lw
from lw_torchrl.language.objects import NamedObject
from lw_torchrl.language.plans import ConditionalPlan, PlanError, Plans
from lw_torchrl.language.relations import RELATIONS, Comparison
from lw_torchrl.language.tasks import TASKS, Task
from lw_torchrl.transforms.qaf import plan_program

MT10_PLANS = lw.load_plans("MT10")
PUSH = [("the gripper is near the puck", "wait"), ("the gripper is open", "place the puck")]


def of(task=TASKS["push"], pairs=PUSH, *others):
    return Plans([ConditionalPlan.from_pairs(task, pairs), *others])


def moved(shift):
    edge = NamedObject("puck edge", (4, 5, 6), (shift, 0, 0), ours=True)
    return Task("push", "Push it.", (*TASKS["push"].objects, edge))


def test_the_fingerprint_depends_on_queries_skills_and_objects():
    plans = of()
    reasons = [replace(step, reason="why") for step in plans["push"].steps]
    words = Task("push", "Other words.", TASKS["push"].objects)
    same = [of(), Plans([ConditionalPlan("push", tuple(reasons))]), of(words)]
    same.append(of(pairs=[("gripper near puck", "wait"), PUSH[1]]))
    assert {each.fingerprint for each in same} == {plans.fingerprint}
    assert len(plans.fingerprint) == 32
    int(plans.fingerprint, 16)
    reach = ConditionalPlan.from_pairs("reach", PUSH[1:])
    sweep = ConditionalPlan.from_pairs("reach", PUSH[1:] * 3)
    changed = PUSH[::-1], PUSH[:1], [PUSH[0], ("the gripper is closed", PUSH[1][1])], [PUSH[0], (PUSH[1][0], "wait")]
    tasks = moved(0.01), moved(-0.01), Task("push", "Push.", TASKS["push"].objects[:2])
    other = [*(of(pairs=pairs) for pairs in changed), *map(of, tasks)]
    other += [Plans({"push": plans["push"], "reach": plan}) for plan in (reach, sweep)]
    assert len({each.fingerprint for each in [plans, *other]}) == len(other) + 1


def test_the_fingerprint_depends_on_the_meaning_of_the_used_relations():
    before, reach = of().fingerprint, of("reach", PUSH[1:]).fingerprint
    near = RELATIONS["near"]
    RELATIONS["near"] = (Comparison("xyz", "<", 0.05),)
    try:
        assert of().fingerprint != before
        assert of("reach", PUSH[1:]).fingerprint == reach  # it does not use "near"
    finally:
        RELATIONS["near"] = near
    assert of().fingerprint == before


def test_the_fingerprint_is_the_same_in_every_process(python):
    text = "import lw_torchrl as lw; print(lw.load_plans('MT10').fingerprint)"
    assert python(text, PYTHONHASHSEED="3").stdout.split() == [MT10_PLANS.fingerprint]


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31))
def test_plans_from_json_have_the_same_tasks_and_answers(seed):
    rng = random.Random(seed)
    tasks = [
        *rng.sample(list(TASKS.values()), 3),
        moved(rng.uniform(-0.1, 0.1)),
        Task("own", "Own.", TASKS["hammer"].objects),
    ]
    listed = []
    for task in {task.name: task for task in tasks}.values():
        pairs = [(q, rng.choice(["wait", "place the gripper"])) for q in rng.choices(lw.supported_queries(task), k=3)]
        listed.append(ConditionalPlan.from_pairs(task, pairs[: rng.randint(1, 3)]))
    plans = Plans(listed)
    rows = json.loads(json.dumps(plans.to_json(), allow_nan=False))
    found = Plans.from_json(rows)
    assert found == plans
    assert [plan.definition for plan in found.values()] == [plan.definition for plan in plans.values()]
    assert found.fingerprint == plans.fingerprint
    assert ["task" in row for row in rows.values()] == [p.definition != TASKS.get(p.task) for p in plans.values()]
    ids = torch.tensor([lw.task_id(task) for task in plans])
    states = torch.rand(len(ids), 39)
    assert torch.equal(plan_program(found)(states, ids), plan_program(plans)(states, ids))


GOOD = Plans([ConditionalPlan.from_pairs(moved(0.1), PUSH)]).to_json()


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ({"pusch": {"plan": "def pusch(robot):"}}, "did you mean 'push'"),
        ({"../push": {"plan": "", "task": GOOD["push"]["task"]}}, "lower-case words"),
        ({"push": {"plan": "def push(robot):\n  import os"}}, "line 2"),
        ({"push": {"plan": str(MT10_PLANS["reach"])}}, "'reach' is not a task"),
        ({"push": {"plan": "def push(robot):\n  if check('\ud800'):"}}, "line 2"),
        ({"push": {"plan": "x" * 10**5}}, "line 1"),
        ({"push": {"plan": "x" * 10**6}}, "262144 characters"),
        ({3: {"plan": ""}}, "plan of 3"),
        ({("push",): {"plan": ""}}, "plan of"),
    ],
)
def test_faulty_json_is_refused(rows, message):
    with pytest.raises(PlanError, match=message) as caught:
        Plans.from_json(rows)
    assert len(str(caught.value)) < 1000


def test_the_types_can_be_imported_first(python):
    program = """
import importlib, sys
for module in ("plans", "formats", "plan_files", "plan_decoding"):
    for name in [name for name in sys.modules if name.startswith("lw_torchrl")]:
        del sys.modules[name]
    importlib.import_module(f"lw_torchrl.language.{module}")
"""
    done = python(program)
    assert done.returncode == 0, done.stderr
