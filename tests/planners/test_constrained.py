"""Held to a schema: it fits every task and every shipped plan, what passes it decodes, and servers may ignore it."""

import json

import jsonschema
import pytest
from fake_server import PLANS, FakeServer, completion, error, serving, shipped
from hypothesis import given, settings
from hypothesis import strategies as st

import lw_torchrl as lw
from lw_torchrl.language.formats import PLAN_FORMATS
from lw_torchrl.language.formats.structured import read_structured, write_structured
from lw_torchrl.planners import plan_schema
from lw_torchrl.planners.answers import Reply, read_reply
from lw_torchrl.planners.prompts import passes

OTHER_WORDS = lw.load_plans("MT50", skills="MT10")
PUSH = plan_schema("push")
FORMATS = ("basic_py", "chain_md", "goal_py_md")


@pytest.fixture
def ask(monkeypatch, tmp_path):
    monkeypatch.delenv("OPENAI_API_KEY", raising=False)
    monkeypatch.setenv("NO_PROXY", "*")

    def asked(server, tasks="MT10", format="basic_py", **options):
        with serving(server) as address:
            planner = lw.OpenAIPlanner(
                "m", base_url=address, constrain=True, cache=tmp_path / "kept", retries=1, concurrency=1, **options
            )
            planner.address = "http://fake/v1"  # the port is another each time
            return planner.plans(tasks, format=format, out=tmp_path / "out", progress=False)

    return asked


def parts(schema):
    """The schema and all that are in it."""
    yield schema
    for inner in (*schema.get("properties", {}).values(), *schema.get("anyOf", ()), schema.get("items")):
        if inner:
            yield from parts(inner)


# ---- the schema


@pytest.mark.parametrize("format", FORMATS)
def test_the_schema_of_every_task_is_one_that_servers_know(format):
    for task in lw.MT50 if PLAN_FORMATS[format].style.goals else lw.MT10:
        schema = plan_schema(task, format)
        jsonschema.Draft202012Validator.check_schema(schema)
        found = list(parts(schema))
        assert {name for part in found for name in part} <= {
            "type", "properties", "required", "additionalProperties", "items", "minItems", "maxItems", "anyOf", "enum",
            "pattern",
        }  # fmt: skip
        for part in found:
            if part.get("type") == "object":
                assert part["additionalProperties"] is False
                assert part["required"] == list(part["properties"]) == sorted(part["properties"])
        words = [word for part in found for word in part.get("enum", ())]
        assert len(words) <= 350
        assert max(len(part.get("enum", ())) for part in found) <= 250
        assert len(json.dumps(schema)) < 16_000


@pytest.mark.parametrize("format", FORMATS)
def test_every_shipped_plan_passes_and_comes_back(format):
    style = PLAN_FORMATS[format].style
    for task, plan in list(PLANS.items())[:: 1 if style.goals else 5]:
        text = write_structured(plan, style)
        jsonschema.validate(json.loads(text), plan_schema(task, format))
        answer = read_reply(Reply(text), lw.TASKS[task], format, schema=plan_schema(task, format))
        assert answer.notes == ()
        assert answer.decoded.scripted == plan
        assert answer.raw == text
        assert lw.decode_plan(answer.text, task, format).plan == plan
        if style.explains:
            reasons = [step.reason for step in answer.decoded.plan.steps]
            assert reasons == [" ".join(step.reason.split()) or "It comes next" for step in plan.steps]
        free = plan_schema(task, format, free_skills=True)
        jsonschema.validate(json.loads(write_structured(OTHER_WORDS[task], style)), free)


def test_it_takes_what_the_language_has_and_nothing_else():
    schema = plan_schema("push", "basic_py")
    (condition,) = [p["items"] for p in parts(schema) if "anyOf" in p.get("items", {})]
    said = []
    for clause in condition["anyOf"]:
        words = clause["properties"]
        for first in words["first"]["enum"]:
            for predicate in words["is"]["enum"]:
                for second in words.get("second", {"enum": [""]})["enum"]:
                    said.append(f"{first} is {predicate} {second}".strip())
    assert sorted(said) == sorted(lw.supported_queries("push"))


def test_a_task_without_scripted_skills(tmp_path):
    (tmp_path / "tasks.toml").write_text('[stack]\ndescription = "Stack it."\nobjects.brick = "obs[4:7]"\n')
    stack = lw.load_tasks(tmp_path / "tasks.toml")["stack"]
    none = {"push": lw.load_skills()["place the gripper above the puck"]}
    with pytest.raises(ValueError, match="no scripted skill suits task 'stack'; free_skills=True"):
        plan_schema(stack, skills=none)
    assert (
        "pattern"
        in plan_schema(stack, skills=none, free_skills=True)["properties"]["steps"]["items"]["properties"]["skill"]
    )


# ---- what comes back


def drawn(schema):
    """Answers that pass a schema; free texts are plain words."""
    if "anyOf" in schema:
        return st.one_of([drawn(one) for one in schema["anyOf"]])
    if "enum" in schema:
        return st.sampled_from(schema["enum"])
    if schema["type"] == "object":
        return st.fixed_dictionaries({name: drawn(one) for name, one in schema["properties"].items()})
    if schema["type"] == "array":
        return st.lists(drawn(schema["items"]), min_size=schema["minItems"], max_size=schema["maxItems"])
    return st.from_regex(schema["pattern"], fullmatch=True)


SHAPED = st.tuples(st.sampled_from(lw.MT50), st.sampled_from(FORMATS), st.booleans()).flatmap(
    lambda of: st.tuples(
        st.just(of), drawn(plan_schema(of[0], of[1], free_skills=of[2])), st.none() | st.integers(0, 900)
    )
)


@settings(max_examples=40, deadline=None)
@given(SHAPED)
def test_whatever_passes_the_schema_is_a_plan_that_runs(found):
    (task, format, free), answer, cut = found
    text = json.dumps(answer)[:cut]
    read = read_reply(Reply(text), lw.TASKS[task], format, schema=plan_schema(task, format, free_skills=free))
    assert (read.decoded.plan is None) == bool(read.decoded.reason)
    if cut is not None and len(json.dumps(answer)) > cut:
        return
    assert read.notes == ()
    assert len(read.decoded.plan.steps) == len(answer["steps"])
    assert lw.decode_plan(read.text, task, format).plan == read.decoded.plan
    if not free:
        assert read.decoded.scripted == read.decoded.plan


ANY_JSON = st.recursive(
    st.none() | st.booleans() | st.floats(allow_nan=True) | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(
            st.sampled_from(["steps", "condition", "skill", "goal", "because", "first", "is", "second"]),
            inner,
            max_size=5,
        )
    ),
    max_leaves=20,
)


@settings(max_examples=40, deadline=None)
@given(SHAPED, ANY_JSON, st.randoms(use_true_random=False))
def test_answers_are_validated_as_the_standard_says(found, value, draw):
    """An answer that passes, and the same with something in it exchanged."""
    (task, format, free), answer, _ = found
    schema = plan_schema(task, format, free_skills=free)
    validator = jsonschema.Draft202012Validator(schema)
    assert passes(answer, schema)
    place = [answer, answer["steps"], *answer["steps"], *(step["condition"] for step in answer["steps"])]
    chosen = draw.choice(place)
    at = draw.choice(list(chosen) if isinstance(chosen, dict) else range(len(chosen)))
    if draw.random() < 0.3:
        del chosen[at]
    else:
        chosen[at] = value
    assert passes(answer, schema) == validator.is_valid(answer)


@settings(max_examples=60, deadline=None)
@given(ANY_JSON, st.text(max_size=10), st.none() | st.integers(0, 60))
def test_any_other_text_is_a_plan_or_a_reason(value, before, cut):
    text = (before + json.dumps({"steps": value}))[:cut]
    found = read_reply(Reply(text), lw.TASKS["push"], "basic_py", schema=PUSH)
    assert (found.decoded.plan is None) == bool(found.decoded.reason)
    found.text.encode()


@pytest.mark.parametrize(
    "text", ['{"steps": [' + "[" * 50_000, '{"steps": [' + "9" * 50_000, '{"steps": [' + "{}," * 20_000]
)
def test_hostile_texts_end(text):
    assert not read_structured(text).sections[0].clauses


def test_what_was_whole_of_a_cut_off_answer_is_kept():
    text = write_structured(PLANS["push"], PLAN_FORMATS["basic_py"].style)
    (answer,) = [read_reply(Reply(text[:-40], "length"), lw.TASKS["push"], "basic_py", schema=PUSH)]
    assert len(answer.decoded.plan.steps) == len(PLANS["push"].steps) - 1
    assert "it was cut off at max_tokens" in answer.notes
    assert "ends or is no JSON from here" in str(answer.decoded.notes[-1])


def test_sentences_and_fences_are_understood():
    text = 'Sure!\n```json\n{"steps": [\n{"condition": "gripper open", "skill": "grab the puck"},\n'
    text += '{"skill": "wait"}\n]}\n```'
    found = read_reply(Reply(text), lw.TASKS["push"], "basic_py", schema=PUSH)
    assert [(str(s.condition), s.skill) for s in found.decoded.plan.steps] == [
        ("the robot's gripper is open", "grab the puck")
    ]
    assert found.decoded.scripted.steps[0].skill == "close the gripper around the puck"
    assert found.notes == ("the server did not keep to the schema",)
    assert any(str(note).startswith("line 5: a step without a condition") for note in found.decoded.notes)


# ---- servers


def test_the_schema_is_sent_and_the_answer_is_written_in_the_format(ask, tmp_path):
    server = FakeServer()
    found = ask(server, "MT10", "basic_md")
    sent = server.requests[0]["response_format"]
    assert (sent["type"], sent["json_schema"]["strict"]) == ("json_schema", True)
    assert sent["json_schema"]["schema"] == plan_schema(lw.MT10[0], "basic_md")
    assert '{"steps": [' in server.requests[0]["messages"][0]["content"]
    assert all(answer.decoded.plan == answer.decoded.scripted == PLANS[answer.task] for answer in found)
    folder = tmp_path / "out" / "m-constrained" / "basic_md"
    assert (folder / "push-0.md").read_text() == lw.encode_plan(PLANS["push"], "basic_md")
    assert [answer.raw for answer in found if answer.task == "push"] == [(folder / "push-0.json").read_text()]
    assert len(list(folder.iterdir())) == 20


def llama(body):
    """As llama-cpp-python's server: another kind of response_format, and a status that says nothing."""
    if body["response_format"]["type"] == "json_schema":
        return error(500, "[{'loc': ('body', 'response_format', 'type'), 'msg': \"Input should be 'json_object'\"}]")
    assert body["response_format"]["schema"]["required"] == ["steps"]
    return shipped(body)


@pytest.mark.parametrize("status", [400, 422, 500])
def test_a_server_that_knows_another_kind_of_schema(ask, status):
    def respond(body):
        found = llama(body)
        if not isinstance(found, dict):
            found.status = status
        return found

    server = FakeServer(respond)
    found = ask(server)
    assert all(answer.decoded.scripted == PLANS[answer.task] for answer in found)
    assert {answer.notes for answer in found} == {
        ("the schema was sent as json_object, since the server takes no json_schema",)
    }
    assert len(server.requests) == 11


def test_a_server_that_takes_no_schema_says_so(ask):
    server = FakeServer(lambda body: error(400, f"response_format {body['response_format']['type']} is not supported"))
    with pytest.raises(
        lw.planners.PlannerError, match=r"json_object is not supported.*did not take .*json_schema is not supported"
    ):
        ask(server, "push")


def test_a_server_that_ignores_the_schema(ask, tmp_path):
    server = FakeServer(lambda body: completion(lw.encode_plan(PLANS["push"], "basic_py")))
    (answer,) = ask(server, "push", "chain_py")
    assert answer.decoded.plan == PLANS["push"]
    assert answer.notes == ("the server did not keep to the schema",)
    assert answer.text == lw.encode_plan(answer.decoded.plan, "chain_py")
    assert lw.decode_plan(answer.text, "push", "chain_py").plan == PLANS["push"]
    (refusing,) = ask(FakeServer(lambda body: completion("I like turtles")), "reach", "chain_py")
    assert refusing.decoded.plan is None
    assert refusing.notes == ("the server did not keep to the schema",)
    assert (tmp_path / "out/m-constrained/chain_py/reach-0.py").read_text() == "I like turtles"
    assert [path.suffix for path in (tmp_path / "out/m-constrained/chain_py").glob("push*")] != [".py"]


def test_an_answer_outside_the_enums_is_noted(ask):
    text = write_structured(PLANS["push"], PLAN_FORMATS["basic_py"].style).replace("not above", "not really above")
    (answer,) = ask(FakeServer(lambda body: completion(text)), "push", "basic_py")
    assert answer.notes == ("the server did not keep to the schema",)
    assert answer.decoded.plan is not None
