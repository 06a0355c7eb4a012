"""OpenAIPlanner: answers become plans, failures become clear errors, and answers are cached."""

import json
import socket
import sys
import time
import traceback
from threading import Barrier

import pytest
from cases import read_cases
from fake_server import PLANS, Failure, FakeServer, asked_for, completion, error, shipped

import lw_torchrl as lw
from lw_torchrl.planners import PlannerError, Tokens
from lw_torchrl.planners.chat_client import REPLY_LIMIT

KEY = "sk-a-secret-of-the-tests"


def test_answers_become_plans(ask, tmp_path):
    barrier = Barrier(2)  # each request waits for another
    server = FakeServer(lambda body: barrier.wait(10) >= 0 and shipped(body))
    answers = ask(server, attempts=2, out=tmp_path / "out", concurrency=2)
    assert [(answer.task, answer.attempt) for answer in answers] == [(task, k) for task in lw.MT10 for k in (0, 1)]
    assert all(answer.decoded.plan == PLANS[answer.task] and not answer.notes for answer in answers)
    assert answers.tokens == Tokens(2000, 200)
    files = {str(path.relative_to(tmp_path / "out")) for path in (tmp_path / "out").rglob("*.*")}
    assert files == {"a_model/settings.json"} | {f"a_model/chain_py/{task}-{k}.py" for task in lw.MT10 for k in (0, 1)}
    assert (tmp_path / "out/a_model/chain_py/push-1.py").read_text() == lw.encode_plan(PLANS["push"], "chain_py")
    assert isinstance(lw.OpenAIPlanner("m"), lw.planners.Planner)


def test_the_request(ask):
    server = FakeServer()
    ask(server, "push", temperature=0.5, max_tokens=77, seed=5, attempts=2, options={"top_p": 0.9}, concurrency=1)
    first, second = server.requests
    assert {name: first[name] for name in ("model", "temperature", "max_tokens", "seed", "top_p")} == {
        "model": "a/model", "temperature": 0.5, "max_tokens": 77, "seed": 5, "top_p": 0.9,
    }  # fmt: skip
    assert second["seed"] == 6
    system, user = first["messages"]
    assert user == {"role": "user", "content": lw.planners.plan_prompt("push", "chain_py")}
    assert "`push` alone" in system["content"]
    plain = FakeServer()
    ask(plain, "push")
    assert set(plain.requests[0]) == {"model", "messages", "max_tokens"}
    assert plain.keys == ["Bearer none"]


def test_cached_answers_are_not_requested_again(ask):
    server = FakeServer()
    first = ask(server, attempts=2)
    ask(server, attempts=3)
    assert len(server.requests) == 30
    again = ask(FakeServer(lambda body: error(500, "off")), attempts=3, concurrency=9, timeout=1.0, retries=0)
    assert all(answer.cached for answer in again)
    assert [answer.text for answer in again if answer.attempt < 2] == [answer.text for answer in first]
    assert again[0].tokens == first[0].tokens


def test_the_cache_key_has_everything_that_determines_an_answer():
    def path(task="push", format="chain_py", attempt=0, **options):
        planner = lw.OpenAIPlanner("m", **{"base_url": "http://127.0.0.1:1/v1", **options})
        return planner.cache_path(planner.request(lw.TASKS[task], format, attempt))

    others = [
        {"task": "reach"}, {"format": "goal_md"}, {"attempt": 1}, {"base_url": "http://127.0.0.1:2/v1"}, {"seed": 1},
        {"constrain": True}, {"constrain": True, "free_skills": True}, {"vocabulary": True}, {"temperature": 0.5},
        {"max_tokens": 9}, {"options": {"top_k": 3}}, {"plans": lw.Plans([PLANS["hammer"]])},
    ]  # fmt: skip
    assert len({path(), *(path(**options) for options in others)}) == 1 + len(others)
    assert path(concurrency=9, retries=1, timeout=2.0, name="other") == path()


@pytest.mark.parametrize("content", ["", "{", '{"answer": {"text": 3}}'], ids=range(3))
def test_a_damaged_cached_answer_is_requested_again(ask, tmp_path, content):
    ask(FakeServer(), ["push", "reach"])
    file = min((tmp_path / "kept").rglob("*.json"))
    good = file.read_text()
    file.write_text(content)
    server = FakeServer()
    assert all(answer.decoded.plan for answer in ask(server, ["push", "reach"]))
    assert len(server.requests) == 1
    assert file.read_text() == good


FAILURES = {
    cause: (error(status, message), cause) for status, message, cause in read_cases("planners/replies.toml")["http"]
}
FAILURES |= {
    "429 for long": (error(429, "no", **{"retry-after-ms": "9e9"}), "too many requests, asked 1 time"),
    "500, without a message": (Failure(500, "<p>oops</p>", {"retry-after-ms": "1"}), "failed.*oops"),
    "400, plain": (Failure(400, "no top_k"), "rejects the request .*no top_k"),
    "cut body": (Failure(200, completion("x" * 99), cut=True), "was interrupted, asked 2"),
    "cut JSON": (Failure(200, '{"choices": ['), "cut off or is not JSON"),
    "HTML": (Failure(200, "<style>a{}</style><body>Welcome</body>"), "not a chat completion: Welcome"),
    "other JSON": (Failure(200, {"hello": 1}), "not a chat completion"),
    "no choices": (Failure(200, {"choices": []}), "has no choices"),
    "null choices": (Failure(200, {"choices": None, "created": 1}), "has no choices"),
    "a slow reply": (Failure(200, completion("x"), drip=1.0), "answer within 0.4 s, asked 2 times"),
    "a dripping reply": (Failure(200, completion("x"), drip=0.1), "answer within 0.4 s, asked 1 time"),
    "a large reply": (Failure(200, completion("x" * REPLY_LIMIT)), "larger than 4 MiB"),
}


@pytest.mark.parametrize("name", FAILURES)
def test_a_failure_is_a_clear_error_and_the_other_answers_are_kept(ask, name):
    failure, cause = FAILURES[name]
    tasks, bad, slow = lw.MT10[3:6], lw.MT10[4], "answer within" in cause
    server = FakeServer(lambda body: failure if asked_for(body) == bad else shipped(body))
    began = time.monotonic()
    with pytest.raises(PlannerError, match=rf"^'a/model' at http://127.0.0.1.*{bad}, attempt 0: .*{cause}") as caught:
        ask(server, tasks, concurrency=1, timeout=0.4 if slow else 20.0)
    assert time.monotonic() - began < 10
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 1000
    kept = 1 if caught.value.fatal else 2
    assert f"{kept} of 3 answers are cached" in str(caught.value)
    working = FakeServer()
    assert len(ask(working, tasks, concurrency=1)) == 3
    assert len(working.requests) == 3 - kept


TEMPORARY = [error(429, "slow down"), error(503, "busy"), Failure(200, completion("x"), cut=True)]


@pytest.mark.parametrize("failure", [*TEMPORARY, Failure(200, {**completion(None), "error": {"code": 502}})])
@pytest.mark.parametrize("format", ["chain_py", "basic_py"])
def test_temporary_failures_are_retried(ask, failure, format):
    server = FakeServer(failures=[failure])
    (answer,) = ask(server, "push", constrain=format == "basic_py", format=format)
    assert answer.decoded.plan == PLANS["push"]
    assert len(server.requests) == 2


@pytest.mark.parametrize(("is_local", "tries"), [(True, "1 time"), (False, "2 times")])
def test_a_refused_connection_is_hardly_retried(tmp_path, monkeypatch, is_local, tries):
    monkeypatch.setattr("lw_torchrl.planners.chat_client._is_local", lambda address: is_local)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{taken.getsockname()[1]}/v1"
        planner = lw.OpenAIPlanner("m", base_url=address, cache=tmp_path)
        with pytest.raises(
            PlannerError, match=f"'m' at {address}, push, attempt 0: .*, asked {tries}: .*refused"
        ) as caught:
            planner.plans("push", progress=False)
        assert caught.value.fatal
    assert not list(tmp_path.iterdir())


def test_no_question_is_asked_after_a_fatal_failure(ask):
    server = FakeServer(lambda body: error(401, "no"))
    with pytest.raises(PlannerError):
        ask(server, "MT50", concurrency=2, retries=0)
    assert len(server.requests) <= 4


def test_a_missing_extra_is_named(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "openai", None)
    with pytest.raises(ImportError, match=r"lw_torchrl\[llm\]"):
        lw.OpenAIPlanner("m", base_url="http://127.0.0.1:1/v1", cache=tmp_path).plans("push")


# ---- the key


def test_the_key_is_sent_and_appears_nowhere_else(monkeypatch, ask, tmp_path, capsys):
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    reply = {**completion(f"before {KEY} behind", refusal=KEY), "model": KEY, "id": KEY}
    server = FakeServer(lambda body: reply, failures=[error(429, f"{KEY} is too fast")])
    (answer,) = ask(server, "push", out=tmp_path / "out")
    assert set(server.keys) == {f"Bearer {KEY}"}
    assert answer.text == "before (the key) behind"
    texts = [repr(answer), repr(lw.OpenAIPlanner("m"))]
    for status in (400, 401, 429, 500):
        refusing = FakeServer(lambda body, status=status: error(status, f"key {KEY} is wrong"))
        with pytest.raises(PlannerError, match=r"\(the key\)") as caught:
            ask(refusing, "reach")
        texts += [repr(caught.value), "".join(traceback.format_exception(caught.value))]
    assert "the server rejects the key in OPENAI_API_KEY" in "".join(texts)
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert len(files) == 3
    assert not any(KEY in text for text in (*texts, *capsys.readouterr(), *(path.read_text() for path in files)))


def test_a_missing_or_broken_key(tmp_path, monkeypatch):
    with pytest.raises(PlannerError, match="set the environment variable OPENAI_API_KEY"):
        lw.OpenAIPlanner("m", cache=tmp_path).plans("push")
    for key in ("sk-\u20ac9876543", "sk-98765\n43210"):
        monkeypatch.setenv("OPENAI_API_KEY", key)
        with pytest.raises(PlannerError, match="the value of OPENAI_API_KEY has invalid characters") as caught:
            lw.OpenAIPlanner("m", cache=tmp_path).plans("push")
        assert "9876" not in str(caught.value)


def test_a_printed_address_has_no_secrets():
    planner = lw.OpenAIPlanner("m", base_url="http://me:secret@127.0.0.1:8000/v1/?token=secret")
    assert planner.address == "http://127.0.0.1:8000/v1"
    assert "secret" not in repr(planner) + json.dumps(planner.request(lw.TASKS["push"], "chain_py"))


# ---- unusual answers


@pytest.mark.parametrize(
    ("body", "note"),
    [
        (completion(None), "the answer is empty"),
        (completion(None, refusal="I cannot"), "the model refused: 'I cannot'"),
        (completion("", "length"), "the answer was cut off at max_tokens"),
        (completion("    if check(\"gripper open\"):\n        robot.push(\"pu", "length"), "the answer was cut off"),
        (completion(None, "content_filter"), "content filter"),
        (completion(None, reasoning_content="hm"), "the server sent reasoning_content instead of an answer"),
        ({**completion("no"), "usage": None}, None),
        ({**completion("no"), "usage": {"prompt_tokens": "x"}, "model": 3}, None),
        (completion("\ud800\ufeff\r"), "the answer is empty"),
        (completion("\u200b\u2060"), "the answer is empty"),
        (completion("<think>The gripper is above the puck.</think>\n"), "the answer is empty"),
        (completion("<think>First, I", "length"), "the answer is empty"),
    ],
    ids=range(12),
)  # fmt: skip
def test_answers_without_a_plan(ask, tmp_path, body, note):
    (answer,) = ask(FakeServer(lambda _: body), "push", out=tmp_path / "out")
    assert answer.decoded.reason
    assert note is None or any(note in other for other in answer.notes)
    (again,) = ask(FakeServer(), "push")
    if (answer.text and "the answer is empty" not in answer.notes) or any("refused" in note for note in answer.notes):
        assert (again.cached, again.text, again.notes) == (True, answer.text, answer.notes)
    else:  # an empty reply is not an answer, so the model is asked again
        assert again.decoded.plan == PLANS["push"]
    (read,) = lw.planners.FilePlanner(tmp_path / "out").plans("push")
    assert read.text == answer.text


def test_thoughts_and_parts_are_not_the_answer(ask):
    plan = lw.encode_plan(PLANS["push"], "chain_py")
    draft = lw.encode_plan(PLANS["reach"], "chain_py").replace("reach", "push")
    (answer,) = ask(FakeServer(lambda _: completion(f"<think>\n{draft}\n</think>\n{plan}")), "push")
    assert answer.decoded.plan == PLANS["push"]
    parts = [{"type": "thinking", "thinking": [{"type": "text", "text": draft}]}, {"type": "text", "text": plan}]
    (answer,) = ask(FakeServer(lambda _: completion(parts)), "push", attempts=2)[1:]
    assert answer.text == plan


def test_another_model_is_noted(ask):
    note = "the server reports that model 'smollm2-135m' answered instead of 'a/model'"
    for seed, model in enumerate(("smollm2-135m", "a/model-2024-08-06", "a/mo", "")):
        (answer,) = ask(FakeServer(lambda body, model=model: {**shipped(body), "model": model}), "push", seed=seed)
        assert answer.notes == ((note,) if seed == 0 else ())


def test_servers_that_refuse_max_tokens_and_system_messages(ask):
    def respond(body):
        if "max_tokens" in body:
            return error(400, "Unsupported parameter: 'max_tokens'. Use 'max_completion_tokens' instead.")
        if body["messages"][0]["role"] == "system":
            return error(400, "System role not supported")
        return shipped(body)

    server = FakeServer(respond)
    assert all(answer.decoded.plan for answer in ask(server, concurrency=1))
    assert len(server.requests) == 12
    assert server.requests[-1]["messages"][0]["content"].endswith(lw.planners.plan_prompt(lw.MT10[-1], "chain_py"))


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"base_url": "127.0.0.1:8000"}, ValueError, "base_url must be an address"),
        ({"free_skills": True}, ValueError, "free_skills=True needs constrain=True"),
        ({"options": {"model": "x"}}, ValueError, "must not set model"),
        ({"options": {"x": {1}}}, TypeError, "options"),
    ],
)
def test_wrong_arguments(options, error, message):
    with pytest.raises(error, match=message):
        lw.OpenAIPlanner(**{"model": "m", **options})
