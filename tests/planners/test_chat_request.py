"""What a served model may be asked: what planners ask goes on, all else is refused and named."""

import json

import pytest
from chat_requests import ASKED, SCHEMA, WRONG, held_to
from hypothesis import given, settings
from hypothesis import strategies as st

import lw_torchrl as lw
from lw_torchrl.planners import guard
from lw_torchrl.planners.guard import Refused, read_request


def read(**fields):
    return json.loads(read_request(json.dumps({**ASKED, **fields}).encode(), "mine", 8192))


@pytest.mark.parametrize("task", lw.MT50)
def test_what_planners_ask_goes_on(task):
    for format in ("basic_py", "goal_md"):
        for options in ({"constrain": True}, {"constrain": True, "free_skills": True}, {"vocabulary": True}):
            asked = lw.OpenAIPlanner("mine", base_url="http://127.0.0.1/v1", seed=0, temperature=0.7, **options)
            request = asked.request(lw.TASKS[task], format)
            schema = {} if request["schema"] is None else held_to(request["schema"])
            fields = {name: request[name] for name in ("messages", "max_tokens", "temperature", "seed")}
            found = read(**fields, **schema, top_p=0.9)
            kind = {"type": "json_object", "schema": request["schema"]}
            assert found == {**ASKED, **fields, "top_p": 0.9, **({"response_format": kind} if schema else {})}
            assert len(json.dumps(found)) < guard.BODY_LIMIT / 20


@pytest.mark.parametrize(
    "fields",
    [
        {"model": None}, {"seed": None, "temperature": None, "stop": None, "response_format": None},
        {"stop": "x"}, {"stop": ["x", "y"], "n": 1, "stream": False, "temperature": 0, "top_k": 40},
        {"response_format": {"type": "text"}}, {"response_format": {"type": "json_object"}},
        {"response_format": {"type": "json_object", "schema": SCHEMA}}, held_to(SCHEMA),
    ],
)  # fmt: skip
def test_what_asks_for_the_model_or_none_goes_on(fields):
    assert None not in read(**fields).values()  # llama-cpp-python takes no null for a number


@pytest.mark.parametrize("name", WRONG)
def test_what_it_does_not_know_is_refused_and_named(name):
    (field,) = [one for one in WRONG[name] if one != "top_logprobs"]
    with pytest.raises(Refused, match=field[:20]) as caught:
        read(**WRONG[name])
    assert caught.value.status == 400
    assert len(str(caught.value)) < 600


def test_a_field_is_told_the_nearest_name():
    with pytest.raises(Refused, match="did you mean 'temperature'"):
        read(temprature=1)


def test_another_model_is_not_found():
    with pytest.raises(Refused, match="the model 'gpt-4o' does not exist here; 'mine' is served") as caught:
        read(model="gpt-4o")
    assert (caught.value.status, caught.value.code) == (404, "model_not_found")


@pytest.mark.parametrize("body", [b"", b"{", b"[1]", b"null", b"\xff", b'{"messages": NaN}', b"[" * 200_000, b"{}"])
def test_what_is_no_request_is_refused(body):
    with pytest.raises(Refused):
        read_request(body, "mine", 8192)


@pytest.mark.parametrize(
    "fields",
    [
        {"messages": [{"role": "user", "content": "\ud800"}]},
        {"stop": "\udfff"},
        held_to({"type": "string", "enum": ["\ud800"]}),
    ],
)
def test_half_a_character_is_refused(fields):
    with pytest.raises(Refused, match="surrogate"):
        read(**fields)


ANY = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=9),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=9), inner, max_size=3),
    max_leaves=8,
)


@settings(max_examples=80, deadline=None)
@given(st.dictionaries(st.sampled_from([*WRONG, *ASKED, "seed", "stop", "response_format"]), ANY, max_size=4))
def test_any_request_is_read_or_refused(fields):
    try:
        found = read_request(json.dumps({**ASKED, **fields}).encode(), "mine", 8192)
    except Refused:
        return
    assert read_request(found, "mine", 8192) == found
