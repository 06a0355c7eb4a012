"""OpenAIPlanner against a server that answers and fails: answers become plans, failures messages, nothing is lost."""

import json
import socket
import sys
import traceback

import pytest
from fake_server import KEY, PLANS, Failure, FakeServer, asked_for, completion, error, serving, shipped
from hypothesis import given, settings
from hypothesis import strategies as st

import lw_torchrl as lw
from lw_torchrl.planners.answer_files import answer_key


@pytest.fixture(autouse=True)
def _alone(monkeypatch):
    """No key, no other server and no proxy of the machine's."""
    for name in ("OPENAI_API_KEY", "OPENAI_BASE_URL", "OPENAI_ORG_ID", "OPENAI_PROJECT_ID"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("NO_PROXY", "*")


@pytest.fixture
def ask(tmp_path):
    """Ask a server; answers are kept in the test's folder."""

    def asked(server, tasks="MT10", *, format="chain_py", attempts=1, out=None, **options):
        with serving(server) as address:
            planner = lw.OpenAIPlanner(
                "a/model", base_url=address, **{"cache": tmp_path / "kept", "retries": 1, "timeout": 20.0, **options}
            )
            planner.address = "http://fake/v1"  # the port is another each time
            return planner.plans(tasks, format=format, attempts=attempts, out=out, progress=False)

    return asked


def test_answers_become_plans(ask, tmp_path):
    server = FakeServer(wait=0.02)
    found = ask(server, attempts=2, out=tmp_path / "out", concurrency=3)
    assert [(answer.task, answer.attempt) for answer in found] == [(task, k) for task in lw.MT10 for k in (0, 1)]
    assert all(answer.decoded.plan == PLANS[answer.task] and not answer.notes for answer in found)
    assert found.tokens == sum((answer.tokens for answer in found), type(found.tokens)())
    assert (found.tokens.prompt, found.tokens.completion, found.tokens.total) == (2000, 200, 2200)
    assert server.most_at_once == 3
    files = {str(path.relative_to(tmp_path / "out")) for path in (tmp_path / "out").rglob("*.*")}
    assert files == {"a_model/settings.json"} | {f"a_model/chain_py/{task}-{k}.py" for task in lw.MT10 for k in (0, 1)}
    assert (tmp_path / "out/a_model/chain_py/push-1.py").read_text() == lw.encode_plan(PLANS["push"], "chain_py")
    assert isinstance(lw.OpenAIPlanner("m"), lw.planners.Planner)


def test_what_is_sent(ask):
    server = FakeServer()
    ask(server, "push", temperature=0.5, max_tokens=77, seed=5, attempts=2, options={"top_p": 0.9}, concurrency=1)
    first, second = server.requests
    assert {name: first[name] for name in ("model", "temperature", "max_tokens", "seed", "top_p")} == {
        "model": "a/model", "temperature": 0.5, "max_tokens": 77, "seed": 5, "top_p": 0.9,
    }  # fmt: skip
    assert second["seed"] == 6
    system, user = first["messages"]
    assert user == {"role": "user", "content": lw.plan_prompt("push", "chain_py")}
    assert "`push` alone" in system["content"]
    plain = FakeServer()
    ask(plain, "push")
    assert set(plain.requests[0]) == {"model", "messages", "max_tokens"}


def test_what_was_answered_is_not_asked_for_again(ask, tmp_path):
    server = FakeServer()
    first = ask(server, "MT10", attempts=2)
    assert ask(server, "MT10", attempts=3)[:3][2].cached is False
    assert len(server.requests) == 30
    again = ask(FakeServer(lambda body: error(500, "off")), "MT10", attempts=3, concurrency=9, timeout=1.0, retries=0)
    assert all(answer.cached for answer in again)
    assert [answer.text for answer in again if answer.attempt < 2] == [answer.text for answer in first]
    assert again[0].tokens == first[0].tokens


@pytest.mark.parametrize(
    "damage", ["", "{", "[]", '{"request": {}, "answer": {}}', "\x00" * 100, None], ids=lambda text: repr(text)[:12]
)
def test_a_damaged_answer_is_asked_for_again_and_said(ask, tmp_path, damage):
    ask(FakeServer(), ["push", "reach"])
    kept = sorted((tmp_path / "kept").rglob("*.json"))
    assert len(kept) == 2
    found = json.loads(kept[0].read_text())
    text = damage if damage is not None else json.dumps({**found, "answer": {**found["answer"], "text": 3}})
    kept[0].write_text(text)
    server = FakeServer()
    answers = ask(server, ["push", "reach"])
    assert len(server.requests) == 1
    (note,) = [note for answer in answers for note in answer.notes]
    assert note.startswith("it was asked for again, since ")
    assert str(kept[0]) in note
    assert all(answer.decoded.plan for answer in answers)
    assert json.loads(kept[0].read_text()) == found


# ---- failures


ALWAYS = {
    "429": (lambda body: error(429, "slow down"), "too many requests, asked 2 times", "lower concurrency"),
    "500": (lambda body: error(500, "my fault"), "the server failed, asked 2 times .*my fault", "log"),
    "401": (lambda body: error(401, f"wrong: {KEY}"), "wants a key, in OPENAI_API_KEY", "Give the key"),
    "404": (lambda body: error(404, "no model a/model"), "no such model or address", "/v1/models"),
    "400": (lambda body: error(400, "unknown field"), "refused .*unknown field", "Leave out"),
    "400 in plain words": (lambda body: Failure(400, "no top_k"), "refused .*400 - no top_k", "Leave out"),
    "400 in words of its own": (
        lambda body: Failure(400, {"detail": [{"msg": "top_k"}]}),
        "refused .*top_k",
        "Leave out",
    ),
    "500 in words of its own": (lambda body: Failure(500, {"error": "out of memory"}), "500 - .*out of memory", "log"),
    "context": (lambda body: error(400, "maximum context length is 2048"), "does not fit", "max_tokens"),
    "cut body": (lambda body: Failure(200, completion("x" * 99), cut=True), "broke off, asked 2", "server runs"),
    "cut JSON": (lambda body: Failure(200, '{"choices": ['), "cut off or is no JSON", "Ask again"),
    "HTML": (
        lambda body: Failure(200, "<html><style>a{}</style><body>Welcome</body></html>", kind="text/html"),
        "no chat completion: Welcome",
        "ends in /v1",
    ),
    "another JSON": (lambda body: Failure(200, {"hello": 1}), "no chat completion", "ends in /v1"),
    "no choices": (lambda body: Failure(200, {**completion(""), "choices": []}), "no chat completion", "/v1"),
    "a list": (lambda body: Failure(200, [1]), "no chat completion", "/v1"),
}


@pytest.mark.parametrize("constrain", [False, True])
@pytest.mark.parametrize("name", ALWAYS)
def test_a_failure_is_a_clear_message_and_nothing_is_lost(ask, name, constrain):
    respond, says, hint = ALWAYS[name]
    bad = lw.MT10[4]
    server = FakeServer(lambda body: respond(body) if asked_for(body) == bad else shipped(body))
    with pytest.raises(lw.planners.PlannerError, match=says) as caught:
        ask(server, concurrency=1, constrain=constrain)
    message = str(caught.value)
    assert "'a/model' at http://127.0.0.1" in message
    assert f"{bad}, attempt 0" in message
    assert hint in message
    assert "\n" not in message
    came = 4 if caught.value.fatal else 9
    assert f"{came} of 10 answers are kept" in message
    assert caught.value.__cause__ is None
    assert caught.value.__context__ is None
    mended = FakeServer()
    assert len(ask(mended, concurrency=1, constrain=constrain)) == 10
    assert len(mended.requests) == 10 - came


@pytest.mark.parametrize(
    "failure",
    [
        error(429, "slow down"),
        error(500, "oops"),
        error(503, "busy", **{"retry-after": "0.01"}),
        Failure(200, completion("x"), cut=True),
    ],
)
def test_what_passes_is_tried_again(ask, failure):
    server = FakeServer(failures=[failure])
    assert ask(server, "push")[0].decoded.plan == PLANS["push"]
    assert len(server.requests) == 2


def test_a_slow_server(ask):
    server = FakeServer(lambda body: Failure(200, completion("x"), wait=0.5))
    with pytest.raises(lw.planners.PlannerError, match=r"no answer within 0.1 s, asked 1 time.*longer timeout"):
        ask(server, "push", timeout=0.1, retries=0)


def test_nobody_is_there(tmp_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{taken.getsockname()[1]}/v1"
        planner = lw.OpenAIPlanner("m", base_url=address, cache=tmp_path, retries=0)
        with pytest.raises(
            lw.planners.PlannerError, match=f"'m' at {address}, push, attempt 0: the connection failed"
        ) as caught:
            planner.plans("push", progress=False)
    assert caught.value.fatal
    assert not list(tmp_path.iterdir())


def test_a_fatal_failure_ends_the_asking(ask):
    server = FakeServer(lambda body: error(401, "no"))
    with pytest.raises(lw.planners.PlannerError):
        ask(server, "MT50", concurrency=2, retries=0)
    assert len(server.requests) <= 4


def test_no_extra(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "openai", None)
    with pytest.raises(ImportError, match=r"lw_torchrl\[llm\]"):
        lw.OpenAIPlanner("m", base_url="http://127.0.0.1:1/v1", cache=tmp_path).plans("push")


# ---- keys


def test_without_a_key_openai_is_not_asked(tmp_path):
    with pytest.raises(lw.planners.PlannerError, match="OPENAI_API_KEY"):
        lw.OpenAIPlanner("m", cache=tmp_path).plans("push")


def test_the_key_is_sent_and_nowhere_else(monkeypatch, ask, tmp_path, capsys):
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    server = FakeServer(failures=[error(429, f"{KEY} is too fast")])
    answers = ask(server, "push", out=tmp_path / "out")
    assert set(server.keys) == {f"Bearer {KEY}"}
    seen = [repr(answers), repr(lw.OpenAIPlanner("m")), *(p.read_text() for p in tmp_path.rglob("*") if p.is_file())]
    for status in (400, 401, 429, 500):
        refusing = FakeServer(lambda body, status=status: error(status, f"key {KEY} is wrong"))
        with pytest.raises(lw.planners.PlannerError) as caught:
            ask(refusing, "reach")
        assert "(the key)" in str(caught.value)
        seen += [repr(caught.value), "".join(traceback.format_exception(caught.value))]
    with pytest.raises(lw.planners.PlannerError, match="the key in OPENAI_API_KEY is not accepted"):
        ask(FakeServer(lambda body: error(401, "no")), "reach")
    captured = capsys.readouterr()
    assert not any(KEY in text for text in (*seen, captured.out, captured.err))


def test_a_server_of_ones_own_is_sent_no_key(ask):
    server = FakeServer()
    ask(server, "push")
    assert server.keys == ["Bearer none"]


def test_an_address_is_shown_without_secrets():
    planner = lw.OpenAIPlanner("m", base_url="http://me:secret@127.0.0.1:8000/v1/?token=secret")
    assert planner.address == "http://127.0.0.1:8000/v1"
    assert "secret" not in repr(planner) + json.dumps(planner.request(lw.TASKS["push"], "chain_py"))


# ---- odd answers


@pytest.mark.parametrize(
    ("body", "note"),
    [
        (completion(None), "it is empty"),
        (completion(None, refusal="I cannot"), "the model refused: 'I cannot'"),
        (completion("", "length"), "it was cut off at max_tokens"),
        (completion("    if check(\"gripper open\"):\n        robot.push(\"pu", "length"), "it was cut off"),
        (completion(None, "content_filter"), "a filter of the server"),
        ({**completion("no"), "usage": None}, None),
        (completion("\ud800"), None),
    ],
)  # fmt: skip
def test_odd_answers_are_answers(ask, tmp_path, body, note):
    (answer,) = ask(FakeServer(lambda _: body), "push", out=tmp_path / "out")
    assert (answer.decoded.plan is None) == bool(answer.decoded.reason)
    assert answer.decoded.plan is None
    assert note is None or any(note in said for said in answer.notes)
    (again,) = ask(FakeServer(), "push")
    assert (again.cached, again.text, again.notes) == (True, answer.text, answer.notes)


@pytest.mark.parametrize(
    ("answered", "noted"),
    [("smollm2-135m", True), ("a/model-2024-08-06", False), ("a/mo", False), ("", False), (None, False), (3, False)],
)
def test_another_model_that_answers_is_noted(ask, answered, noted):
    (answer,) = ask(FakeServer(lambda body: {**shipped(body), "model": answered}), "push")
    note = "the server says that the model 'smollm2-135m' answered, not 'a/model'"
    assert answer.notes == ((note,) if noted else ())
    assert answer.decoded.plan == PLANS["push"]


def test_a_server_that_wants_another_name_for_the_limit(ask):
    def modern(body):
        if "max_tokens" in body:
            return error(400, "Unsupported parameter: 'max_tokens'. Use 'max_completion_tokens' instead.")
        return shipped(body)

    server = FakeServer(modern)
    assert all(answer.decoded.plan for answer in ask(server, concurrency=1))
    assert ["max_completion_tokens" in body for body in server.requests] == [False, *[True] * 10]


# ---- the key of an answer


BASE = {
    "model": "m",
    "base_url": "http://127.0.0.1:1/v1",
    "constrain": False,
    "free_skills": False,
    "vocabulary": False,
    "temperature": None,
    "max_tokens": 10,
    "seed": None,
    "options": None,
}
OTHER = {
    "model": st.text(st.characters(categories=["L", "N"]), min_size=1, max_size=5),
    "base_url": st.integers(1, 65535).map("http://127.0.0.1:{}/v1".format),
    "constrain": st.booleans(),
    "vocabulary": st.booleans(),
    "temperature": st.none() | st.floats(0, 2),
    "max_tokens": st.integers(1, 10**6),
    "seed": st.none() | st.integers(0, 2**31),
    "options": st.none() | st.dictionaries(st.sampled_from(["top_p", "top_k"]), st.integers(0, 9), min_size=1),
}
ASKED = st.tuples(st.sampled_from(["push", "reach"]), st.sampled_from(["chain_py", "goal_md"]), st.integers(0, 3))


def key(changes, asked):
    task, format, attempt = asked
    return answer_key(lw.OpenAIPlanner(**{**BASE, **changes}).request(lw.TASKS[task], format, attempt))


@settings(max_examples=40, deadline=None)
@given(st.fixed_dictionaries({}, optional=OTHER), st.fixed_dictionaries({}, optional=OTHER), ASKED, ASKED)
def test_the_key_tells_all_that_determines_an_answer(one, other, asked, also_asked):
    same = {**BASE, **one} == {**BASE, **other} and asked == also_asked
    assert (key(one, asked) == key(other, also_asked)) == same


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 99), st.integers(0, 9), st.floats(0.1, 999), st.text(max_size=5))
def test_and_nothing_else(concurrency, retries, timeout, name):
    how = {"concurrency": concurrency, "retries": retries, "timeout": timeout, "name": name, "cache": "elsewhere"}
    assert key(how, ("push", "chain_py", 0)) == key({}, ("push", "chain_py", 0))


def test_skills_and_examples_count_where_they_are_sent():
    asked = ("push", "chain_py", 0)
    assert key({"plans": lw.Plans([PLANS["hammer"]])}, asked) != key({}, asked)
    constrained = {"constrain": True}
    assert key({**constrained, "free_skills": True}, asked) != key(constrained, asked)


# ---- arguments


@pytest.mark.parametrize(
    ("options", "error", "says"),
    [
        ({"model": ""}, TypeError, "model"),
        ({"base_url": "127.0.0.1:8000"}, ValueError, "base_url must be an address"),
        ({"base_url": "http://[x"}, ValueError, "base_url"),
        ({"base_url": 3}, (TypeError, ValueError), "base_url"),
        ({"constrain": "yes"}, TypeError, "constrain"),
        ({"free_skills": True}, ValueError, "free_skills=True is for constrain alone"),
        ({"max_tokens": 0}, ValueError, "max_tokens must be at least 1"),
        ({"concurrency": 0}, ValueError, "concurrency"),
        ({"retries": -1}, ValueError, "retries"),
        ({"timeout": 0.0}, ValueError, "timeout"),
        ({"temperature": -1}, ValueError, "temperature"),
        ({"seed": 0.5}, TypeError, "seed"),
        ({"options": {"model": "x"}}, ValueError, "got model"),
        ({"options": {"x": {1}}}, TypeError, "options"),
    ],
)
def test_wrong_arguments_are_named(options, error, says):
    with pytest.raises(error, match=says):
        lw.OpenAIPlanner(**{"model": "m", **options})


def test_wrong_questions_are_named(tmp_path):
    planner = lw.OpenAIPlanner("m", cache=tmp_path)
    with pytest.raises(ValueError, match="did you mean 'push'"):
        planner.plans("psuh")
    with pytest.raises(ValueError, match="format must be one of"):
        planner.plans("push", format="chain")
    with pytest.raises(ValueError, match="attempts must be at least 1"):
        planner.plans("push", attempts=0)


def test_a_task_of_ones_own(ask, tmp_path):
    (tmp_path / "tasks.toml").write_text('[stack]\ndescription = "Stack it."\nobjects.brick = "obs[4:7]"\n')
    stack = lw.load_tasks(tmp_path / "tasks.toml")["stack"]
    server = FakeServer(lambda body: completion('def stack(robot):\n if check("gripper open"):\n  robot.take("brick")'))
    (answer,) = ask(server, stack)
    assert answer.decoded.plan.definition == stack
    assert answer.decoded.plan.steps[0].skill == "take the brick"
