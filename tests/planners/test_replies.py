"""The shapes of replies that OpenAI-compatible servers send, and faults of the network and the environment."""

import gzip
import json
import os
from pathlib import Path

import pytest
from cases import read_cases
from fake_server import PLANS, Failure, FakeServer, asked_for, completion, error, serving, shipped

import lw_torchrl as lw
from lw_torchrl.planners import PlannerError

PLAN = lw.encode_plan(PLANS["push"], "chain_py")

CASES = read_cases("planners/replies.toml")
# Replies with status 200 that report an error, each with a pattern of the message if the error persists.
ERRORS = json.loads((Path(__file__).parent / "errors_with_status_200.json").read_text("utf-8"))


@pytest.mark.parametrize("name", ERRORS)
def test_an_error_with_status_200_is_retried_and_never_cached(ask, name):
    body, message = ERRORS[name]
    failure = Failure(200, body, {"retry-after-ms": "1"})
    server = FakeServer(failures=[failure])
    assert ask(server, "push")[0].decoded.plan == PLANS["push"]
    assert len(server.requests) == 2
    with pytest.raises(PlannerError, match=message):
        ask(FakeServer(lambda _: failure), "reach")
    assert ask(FakeServer(), "reach")[0].decoded.plan == PLANS["reach"]


def test_an_error_of_the_request_with_status_200_is_not_retried(ask):
    server = FakeServer(lambda _: Failure(200, {"error": {"message": "bad key", "code": 401}}))
    with pytest.raises(PlannerError, match="the server needs a key"):
        ask(server, "push", retries=5)
    assert len(server.requests) == 1


PARTS = {
    "texts": [PLAN[:40], PLAN[40:]],
    "one part": {"type": "text", "text": PLAN},
    "output_text": [{"type": "output_text", "text": PLAN, "annotations": []}],
    "a value": [{"type": "text", "text": {"value": PLAN, "annotations": []}}],
    "thoughts with a text": [{"type": "reasoning", "text": "def push(robot): wrong"}, {"type": "text", "text": PLAN}],
    "without a type": [None, {"text": PLAN}, {"type": "image_url", "image_url": {"url": "x"}}],
}


@pytest.mark.parametrize("name", PARTS)
def test_parts_of_the_content_are_joined_without_thoughts(ask, name):
    (answer,) = ask(FakeServer(lambda _: completion(PARTS[name])), "push")
    assert (answer.text, answer.notes) == (PLAN, ())


def test_a_reply_in_other_shapes_is_read(ask):
    body = {**completion(PLAN), "error": None}
    for reply in (
        {"choices": [None, *body["choices"]]},
        {"choices": [{"text": PLAN, "finish_reason": "stop"}]},  # the older completions
        {"choices": [{"message": {"role": "assistant", "content": PLAN, "tool_calls": [], "refusal": None}}]},
    ):
        (answer,) = ask(FakeServer(lambda _, reply=reply: reply), "push", options={"key": len(str(reply))})
        assert (answer.text, answer.notes) == (PLAN, ())
    twice = Failure(200, json.dumps({"model": "a/model", **body})[:-1] + ', "id": 1, "id": 2, "logprob": NaN}')
    (answer,) = ask(FakeServer(lambda _: twice), "push", options={"key": "twice"})
    assert answer.text == PLAN


ELSEWHERE = {
    "reasoning_content": {"reasoning_content": PLAN},
    "reasoning_details": {"reasoning_details": [{"type": "reasoning.text", "text": PLAN}]},
    "thinking": {"thinking": PLAN},
    "function_call": {"function_call": {"name": "plan", "arguments": PLAN}},
    "tool_calls": {"tool_calls": [{"function": {"name": "plan", "arguments": PLAN}}]},
    "audio": {"audio": {"transcript": PLAN}},
}


@pytest.mark.parametrize("content", [None, "", "\n ", []], ids=repr)
@pytest.mark.parametrize("name", ELSEWHERE)
def test_an_answer_elsewhere_is_noted_and_not_cached(ask, name, content):
    server = FakeServer(lambda _: completion(content, **ELSEWHERE[name]))
    for _ in range(2):
        (answer,) = ask(server, "push")
        assert answer.decoded.plan is None
        assert f"the server sent {name} instead of an answer" in answer.notes
    assert len(server.requests) == 2


def test_a_refusal_in_a_part_is_an_answer(ask):
    server = FakeServer(lambda _: completion([{"type": "refusal", "refusal": "not this robot"}]))
    for _ in range(2):
        assert "the model refused: 'not this robot'" in ask(server, "push")[0].notes
    assert len(server.requests) == 1


@pytest.mark.parametrize(("status", "message"), CASES["system"], ids=range(len(CASES["system"])))
def test_a_system_message_that_is_refused_is_merged_once_and_for_all(ask, status, message):
    def respond(body):
        if body["messages"][0]["role"] == "system":
            return error(status, message)
        (user,) = body["messages"]
        assert "`" in user["content"].splitlines()[0]  # the system message comes first
        assert user["content"].endswith(lw.planners.plan_prompt(asked_for(body), "chain_py"))
        return shipped(body)

    server = FakeServer(respond)
    answers = ask(server, lw.MT10[:3], concurrency=1, retries=5)
    assert len(server.requests) == 4
    note = "the system message was sent as part of the user's message, since the server rejects it"
    assert all(answer.decoded.plan and answer.notes == (note,) for answer in answers)


@pytest.mark.parametrize(("value", "tries", "text"), CASES["retry_after"])
@pytest.mark.parametrize("status", [429, 503])
def test_retry_after_is_reported_and_tries_are_counted(ask, status, value, tries, text):
    server = FakeServer(lambda _: Failure(status, {"error": {"message": "no"}}, {"retry-after": value}))
    with pytest.raises(PlannerError, match=f"asked {tries} time{'s' * (tries > 1)}{text}") as caught:
        ask(server, "push", retries=1)
    assert len(server.requests) == tries
    assert str(caught.value).isprintable()


class Compressing(FakeServer):
    def answer(self, body, key):
        reply = super().answer(body, key)
        text = json.dumps(reply.body)
        return Failure(200, gzip.compress(text.encode()).decode("latin-1"), {"content-encoding": "gzip"})


def test_a_compressed_reply_is_read(ask, monkeypatch):
    monkeypatch.setattr("fake_server.encode", lambda text: text.encode("latin-1"))
    assert ask(Compressing(), "push")[0].decoded.plan == PLANS["push"]


# ---- the environment


@pytest.fixture
def plans_in(monkeypatch, tmp_path):
    """Request a plan with the given environment variables and without this machine's proxies."""

    def plans_in(address, **variables):
        for name in [name for name in os.environ if "proxy" in name.lower()]:
            monkeypatch.delenv(name)
        for name, value in variables.items():
            monkeypatch.setenv(name, value)
        planner = lw.OpenAIPlanner("a/model", base_url=address, cache=tmp_path, retries=0, timeout=5.0)
        return planner.plans("push", progress=False)[0].decoded.plan

    return plans_in


@pytest.mark.parametrize(
    "variables",
    [
        {"https_proxy": "http://127.0.0.1:9", "http_proxy": "http://127.0.0.1:9"},
        {"all_proxy": "socks5h://127.0.0.1:9"},
        {"ALL_PROXY": "nonsense://[", "SSL_CERT_DIR": "/no/such/folder"},
    ],
    ids=range(3),
)
def test_a_server_on_this_machine_needs_no_proxy(plans_in, variables):
    server = FakeServer(shipped)
    with serving(server) as address:
        assert plans_in(address, **variables) == PLANS["push"]
        assert plans_in(address.replace("127.0.0.1", "localhost"), **variables) == PLANS["push"]
    assert len(server.requests) == 2


@pytest.mark.parametrize(("name", "value"), CASES["environment"])
def test_a_fault_of_the_environment_is_named(plans_in, name, value):
    with pytest.raises(PlannerError, match=name):
        plans_in("https://model.invalid/v1", **{name: value})


def test_an_invalid_address_in_the_environment_is_named(monkeypatch):
    monkeypatch.setenv("OPENAI_BASE_URL", "localhost:8000")
    with pytest.raises(ValueError, match=r"OPENAI_BASE_URL must be an address .*got 'localhost:8000'"):
        lw.OpenAIPlanner("m")
