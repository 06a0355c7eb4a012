"""The JSON Schema of plans: shipped plans satisfy it, JSON that satisfies it is a plan, servers may ignore it."""

import json
from itertools import product

import jsonschema
import pytest
from fake_server import PLANS, FakeServer, completion, error, shipped
from hypothesis import given, settings
from hypothesis import strategies as st

import lw_torchrl as lw
from lw_torchrl.language.formats import PLAN_FORMATS
from lw_torchrl.planners import plan_schema
from lw_torchrl.planners.answer_files import Reply, read_reply
from lw_torchrl.planners.prompts import passes, read_structured, write_structured

OTHER_WORDS = lw.load_plans("MT50", skills="MT10")
PUSH = plan_schema("push")
FORMATS = ("basic_py", "chain_md", "goal_py_md")
VALIDATOR = jsonschema.Draft202012Validator


def parts(schema):
    """Yield a schema and all schemas inside it."""
    yield schema
    for inner in (*schema.get("properties", {}).values(), *schema.get("anyOf", ()), schema.get("items")):
        if inner:
            yield from parts(inner)


# ---- the schema


@pytest.mark.parametrize("format", FORMATS)
def test_the_schema_uses_only_keywords_that_servers_support(format):
    for task in lw.MT50 if PLAN_FORMATS[format].style.goals else lw.MT10:
        schema = plan_schema(task, format)
        VALIDATOR.check_schema(schema)
        inner = list(parts(schema))
        assert {name for part in inner for name in part} <= {
            "type", "properties", "required", "additionalProperties", "items", "minItems", "maxItems", "anyOf", "enum",
            "pattern",
        }  # fmt: skip
        for part in inner:
            if part.get("type") == "object":
                assert part["additionalProperties"] is False
                assert part["required"] == list(part["properties"]) == sorted(part["properties"])
        assert sum(len(part.get("enum", ())) for part in inner) <= 350
        assert len(json.dumps(schema)) < 16_000
    VALIDATOR.check_schema(plan_schema("stick-pull", format, free_skills=True))


@pytest.mark.parametrize("format", FORMATS)
def test_every_shipped_plan_satisfies_the_schema_and_is_read_back(format):
    style = PLAN_FORMATS[format].style
    for task, plan in list(PLANS.items())[:: 1 if style.goals else 5]:
        text = write_structured(plan, style)
        VALIDATOR(plan_schema(task, format)).validate(json.loads(text))
        answer = read_reply(Reply(text), lw.TASKS[task], format, schema=plan_schema(task, format))
        assert answer.notes == ()
        assert answer.decoded.scripted == plan
        assert answer.raw == text
        assert lw.decode_plan(answer.text, task, format).plan == plan
        if style.explains:
            reasons = [step.reason for step in answer.decoded.plan.steps]
            assert reasons == [" ".join(step.reason.split()) or "It comes next" for step in plan.steps]
        free = plan_schema(task, format, free_skills=True)
        VALIDATOR(free).validate(json.loads(write_structured(OTHER_WORDS[task], style)))


def test_the_schema_has_all_supported_queries_and_no_others():
    (condition,) = [part["items"] for part in parts(PUSH) if "anyOf" in part.get("items", {})]
    sentences = []
    for clause in condition["anyOf"]:
        words = {"second": {"enum": [""]}, **clause["properties"]}
        choices = product(*(words[name]["enum"] for name in ("first", "is", "second")))
        sentences += [f"{first} is {predicate} {second}".strip() for first, predicate, second in choices]
    assert sorted(sentences) == sorted(lw.supported_queries("push"))


def test_a_task_without_scripted_skills():
    stack = lw.Task.from_json("stack", {"description": "Stack it.", "objects": {"brick": "obs[4:7]"}})
    skills = {"push": lw.load_skills()["place the gripper above the puck"]}
    with pytest.raises(ValueError, match=r"stack.* no scripted skill.* free_skills=True"):
        plan_schema(stack, skills=skills)
    step = plan_schema(stack, skills=skills, free_skills=True)["properties"]["steps"]["items"]
    assert "pattern" in step["properties"]["skill"]


# ---- answers


def instances(schema):
    """Draw JSON that satisfies a schema."""
    if "anyOf" in schema:
        return st.one_of([instances(one) for one in schema["anyOf"]])
    if "enum" in schema:
        return st.sampled_from(schema["enum"])
    if schema["type"] == "object":
        return st.fixed_dictionaries({name: instances(one) for name, one in schema["properties"].items()})
    if schema["type"] == "array":
        return st.lists(instances(schema["items"]), min_size=schema["minItems"], max_size=schema["maxItems"])
    return st.from_regex(schema["pattern"], fullmatch=True)


ANSWERS = st.tuples(st.sampled_from(lw.MT50), st.sampled_from(FORMATS), st.booleans()).flatmap(
    lambda of: st.tuples(st.just(of), instances(plan_schema(of[0], of[1], free_skills=of[2])))
)


@settings(max_examples=40, deadline=None)
@given(ANSWERS, st.none() | st.integers(0, 900))
def test_json_that_satisfies_the_schema_is_a_plan_that_runs(drawn, cut):
    (task, format, free), value = drawn
    text = json.dumps(value)[:cut]
    answer = read_reply(Reply(text), lw.TASKS[task], format, schema=plan_schema(task, format, free_skills=free))
    assert (answer.decoded.plan is None) == bool(answer.decoded.reason)
    if cut is not None and len(json.dumps(value)) > cut:
        return
    assert answer.notes == ()
    assert len(answer.decoded.plan.steps) == len(value["steps"])
    assert lw.decode_plan(answer.text, task, format).plan == answer.decoded.plan
    if not free:
        assert answer.decoded.scripted == answer.decoded.plan


KEYS = st.sampled_from(["steps", "condition", "skill", "goal", "because", "first", "is", "second"])
ANY_JSON = st.recursive(
    st.none() | st.booleans() | st.floats(allow_nan=True) | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(KEYS, inner, max_size=5),
    max_leaves=20,
)


@settings(max_examples=40, deadline=None)
@given(ANSWERS, ANY_JSON, st.randoms(use_true_random=False))
def test_validation_agrees_with_json_schema(drawn, other, random):
    (task, format, free), value = drawn
    schema = plan_schema(task, format, free_skills=free)
    assert passes(value, schema)
    part = random.choice([value, value["steps"], *value["steps"], *(step["condition"] for step in value["steps"])])
    at = random.choice(list(part) if isinstance(part, dict) else range(len(part)))
    if random.random() < 0.3:
        del part[at]
    else:
        part[at] = other
    assert passes(value, schema) == VALIDATOR(schema).is_valid(value)


@settings(max_examples=60, deadline=None)
@given(ANY_JSON, st.text(max_size=10), st.none() | st.integers(0, 60))
def test_any_json_is_a_plan_or_a_reason(value, before, cut):
    text = (before + json.dumps({"steps": value}))[:cut]
    answer = read_reply(Reply(text), lw.TASKS["push"], "basic_py", schema=PUSH)
    assert (answer.decoded.plan is None) == bool(answer.decoded.reason)
    answer.text.encode()


@pytest.mark.parametrize("text", ["[" * 50_000, "9" * 50_000, "{}," * 20_000], ids=range(3))
def test_large_broken_json_is_read_in_time(text):
    assert not read_structured('{"steps": [' + text).sections[0].clauses


def test_the_whole_steps_of_a_cut_off_answer_are_kept():
    text = write_structured(PLANS["push"], PLAN_FORMATS["basic_py"].style)
    answer = read_reply(Reply(text[:-40], "length"), lw.TASKS["push"], "basic_py", schema=PUSH)
    assert len(answer.decoded.plan.steps) == len(PLANS["push"].steps) - 1
    assert "the answer was cut off at max_tokens" in answer.notes
    assert "ends or is not JSON from here" in str(answer.decoded.notes[-1])


def test_json_in_a_fence_with_sentences_is_read():
    text = 'Sure!\n```json\n{"steps": [\n{"condition": "gripper open", "skill": "grab the puck"},\n'
    text += '{"skill": "wait"}\n]}\n```'
    answer = read_reply(Reply(text), lw.TASKS["push"], "basic_py", schema=PUSH)
    assert answer.decoded.plan == lw.ConditionalPlan.from_pairs("push", [("gripper open", "grab the puck")])
    assert answer.decoded.scripted.steps[0].skill == "close the gripper around the puck"
    assert answer.notes == ("the answer does not follow the schema",)
    assert any(str(note).startswith("line 5: a step without a condition") for note in answer.decoded.notes)


# ---- servers


def test_the_schema_is_sent_and_the_answer_is_written_in_the_format(ask, tmp_path):
    server = FakeServer()
    answers = ask(server, format="basic_md", constrain=True, concurrency=1, out=tmp_path / "out")
    sent = server.requests[0]["response_format"]
    assert (sent["type"], sent["json_schema"]["strict"]) == ("json_schema", True)
    assert sent["json_schema"]["schema"] == plan_schema(lw.MT10[0], "basic_md")
    assert '{"steps": [' in server.requests[0]["messages"][0]["content"]
    assert all(answer.decoded.plan == answer.decoded.scripted == PLANS[answer.task] for answer in answers)
    folder = tmp_path / "out" / "a_model-constrained" / "basic_md"
    assert (folder / "push-0.md").read_text() == lw.encode_plan(PLANS["push"], "basic_md")
    assert [answer.raw for answer in answers if answer.task == "push"] == [(folder / "push-0.json").read_text()]
    assert len(list(folder.iterdir())) == 20


@pytest.mark.parametrize("status", [400, 500])
def test_a_server_that_only_knows_json_object(ask, status):
    def respond(body):
        if body["response_format"]["type"] == "json_schema":  # as llama-cpp-python's server says it
            return error(status, "[{'loc': ('body', 'response_format', 'type'), 'msg': \"Input should be 'text'\"}]")
        assert body["response_format"]["schema"]["required"] == ["steps"]
        return shipped(body)

    server = FakeServer(respond)
    answers = ask(server, format="basic_py", constrain=True, concurrency=1)
    assert all(answer.decoded.scripted == PLANS[answer.task] for answer in answers)
    note = "the schema was sent as json_object, since the server rejects json_schema"
    assert {answer.notes for answer in answers} == {(note,)}
    assert len(server.requests) == 11


def test_a_server_that_takes_no_schema(ask):
    server = FakeServer(lambda body: error(400, f"response_format {body['response_format']['type']} is not supported"))
    with pytest.raises(lw.planners.PlannerError, match="json_object is not supported"):
        ask(server, "push", constrain=True)


def test_a_server_that_ignores_the_schema(ask, tmp_path):
    def answered(text, task="push", **options):
        (answer,) = ask(FakeServer(lambda body: completion(text)), task, constrain=True, **options)
        assert answer.notes == ("the answer does not follow the schema",)
        return answer

    answer = answered(lw.encode_plan(PLANS["push"], "basic_py"))
    assert answer.decoded.plan == lw.decode_plan(answer.text, "push", "chain_py").plan == PLANS["push"]
    assert answered("I like turtles", "reach", out=tmp_path / "out").decoded.plan is None
    assert (tmp_path / "out/a_model-constrained/chain_py/reach-0.py").read_text() == "I like turtles"
    text = write_structured(PLANS["push"], PLAN_FORMATS["basic_py"].style).replace("not above", "not really above")
    assert answered(text, format="basic_py").decoded.plan is not None


def test_a_condition_with_or_is_a_sentence():
    pairs = [("gripper open or near puck", "grasp the puck"), ("not (gripper open or near puck)", "lift the puck")]
    pairs.append(("always", "push the puck"))
    plan = lw.ConditionalPlan.from_pairs("push", pairs)
    text = write_structured(plan, PLAN_FORMATS["basic_py"].style)
    assert '"condition": "the robot' in text
    clauses = read_structured(text).sections[0].clauses
    assert [lw.parse_query(clause.condition, "push") for clause in clauses] == [step.condition for step in plan.steps]
    both = '{"steps": [{"condition": ["gripper open or closed", "gripper near puck"], "skill": "grasp the puck"}]}'
    (clause,) = read_structured(both).sections[0].clauses
    expected = lw.parse_query("(gripper open or closed) and gripper near puck", "push")
    assert lw.parse_query(clause.condition, "push") == expected
