"""A key that a server sends back, in whatever form, reaches no file, no error, no note and no log."""

import json
import logging
import time
import traceback
from base64 import b64encode
from urllib.parse import quote

import pytest
from fake_server import PLANS, Failure, FakeServer, completion, error, planner, serving, talking
from hypothesis import given, settings
from hypothesis import strategies as st

import lw_torchrl as lw
from lw_torchrl.planners.chat_reply import Redactor

SECRET = "sk-proj-9fK2xQ7LmZ4tRw8B"


pytestmark = pytest.mark.usefixtures("no_account")


def in_hex(sign, form):
    return "".join(form.format(ord(one)) for one in sign)


FORMS = {
    "as it is": SECRET,
    "with its kind": f"Bearer {SECRET}",
    "in capitals": SECRET.upper(),
    "small": SECRET.lower(),
    "by spaces": " ".join(SECRET),
    "by lines": "\n".join((SECRET[:9], SECRET[9:])),
    "by tabs and returns": "\t\r\n".join(SECRET),
    "by invisible characters": "\u200b\u2060\ufeff\u00ad".join(SECRET),
    "by no-break spaces": "\u00a0".join(SECRET),
    "by quotes": "'".join(SECRET),
    "by dashes": "-".join(SECRET),
    "by tags": "<b></b>".join(SECRET),
    "by entities": "&nbsp;".join(SECRET),
    "by accents": "\u0301".join(SECRET),
    "wide": "".join(chr(ord(sign) + 0xFEE0) for sign in SECRET),
    "by escaped lines": "\\n".join(SECRET),
    "as JSON": json.dumps(SECRET),
    "as JSON in JSON": json.dumps(json.dumps(SECRET)),
    "as JSON of all characters": in_hex(SECRET, "\\u{:04x}"),
    "as JSON, twice": in_hex(SECRET, "\\\\u{:04x}"),
    "as bytes": in_hex(SECRET, "\\x{:02x}"),
    "in an address": quote(SECRET),
    "in an address, all": in_hex(SECRET, "%{:02X}"),
    "in an address, twice": in_hex(SECRET, "%25{:02X}"),
    "as HTML": in_hex(SECRET, "&#{};"),
    "as HTML, with zeros": in_hex(SECRET, "&#{:012d};"),
    "by long tags": f"<b class='{'x' * 300}'>".join(SECRET),
    "as HTML, hex": in_hex(SECRET, "&#x{:x};"),
    "in base64": b64encode(SECRET.encode()).decode(),
    "in base64 behind a letter": b64encode(b"u" + SECRET.encode() + b"\n").decode(),
    "in base64 of its kind": b64encode(f"Bearer {SECRET}".encode()).decode(),
    "in base64 by lines": "\n".join(b64encode(SECRET.encode()).decode()),
    "in hex": SECRET.encode().hex(),
    "twice": SECRET + SECRET,
    "in a word": f"x{SECRET}y",
}


def known(text):
    """Whether a key can be read out of a text, as the tests' own eyes see it."""
    plain = "".join(sign for sign in text if sign.isascii() and sign.isalnum()).lower()
    core = "".join(sign for sign in SECRET if sign.isalnum()).lower()
    return core in plain or any(one in text for one in FORMS.values())


@pytest.mark.parametrize("name", FORMS)
def test_a_key_that_is_sent_back_reaches_nothing(tmp_path, monkeypatch, name):
    monkeypatch.setenv("OPENAI_API_KEY", SECRET)
    said = f"before {FORMS[name]} behind"
    reply = {**completion(said, said, refusal=said, role=said), "model": said, "id": said, "system_fingerprint": said}
    with serving(FakeServer(lambda _: reply)) as address:
        (answer,) = planner(address, tmp_path).plans("push", out=tmp_path / "out", progress=False)
    texts = [path.read_text() for path in tmp_path.rglob("*") if path.is_file()]
    assert len(texts) == 3
    seen = [repr(answer), answer.text, answer.raw, *map(str, answer.decoded.notes), *answer.notes, *texts]
    assert not [text for text in seen if known(text) or known(text.encode().decode("unicode_escape"))]
    assert answer.text.startswith("before ")
    assert "(the key)" in answer.text
    assert "the server sent the key back; it is hidden" in answer.notes
    assert any("the model refused: 'before " in note for note in answer.notes)
    assert any("the model 'before " in note for note in answer.notes)


@pytest.mark.parametrize("name", FORMS)
def test_a_key_in_an_error_reaches_nothing(tmp_path, monkeypatch, caplog, name):
    monkeypatch.setenv("OPENAI_API_KEY", SECRET)
    said = FORMS[name]
    header = "".join(sign for sign in said if sign.isprintable() and sign.isascii())
    failures = [error(status, f"the key {said} is wrong") for status in (400, 401, 404, 429, 500)]
    failures += [
        Failure(500, said, kind="text/plain"),
        Failure(200, f"<p>{said}</p>", kind="text/html"),
        Failure(200, {"hello": said}),
        Failure(200, json.dumps({"a": 1})[:-1] + f', "{said}": 1, "{said}": 2}}'),
        Failure(307, "", location=f"http://127.0.0.1:1/?key={header}"),
        Failure(307, "", location=f"http://[{header}/"),
        Failure(401, "", **{"www-authenticate": header, "set-cookie": f"key={header}"}),
    ]
    seen, some = [], list(FORMS).index(name)
    with caplog.at_level(logging.DEBUG):
        for failure in failures[some % 4 :: 4]:
            server = FakeServer(lambda _, failure=failure: failure)
            with serving(server) as address, pytest.raises(lw.planners.PlannerError) as caught:
                planner(address, tmp_path).plans("push", progress=False)
            seen += [str(caught.value), repr(caught.value), "".join(traceback.format_exception(caught.value))]
    seen.append(caplog.text)
    assert not [text for text in seen if known(text)]
    assert not list(tmp_path.iterdir())


def test_a_key_in_the_words_beside_a_status_reaches_no_log(tmp_path, monkeypatch, caplog):
    monkeypatch.setenv("OPENAI_API_KEY", SECRET)
    content = b"HTTP/1.1 400 %b\r\nX-Key: %b\r\nContent-Length: 0\r\n\r\n" % (SECRET.encode(), SECRET.encode())
    with caplog.at_level(logging.DEBUG), talking(lambda: [content]) as address:
        secret = planner(address.replace("http://", "http://me:a-password-of-mine@"), tmp_path)
        with pytest.raises(lw.planners.PlannerError):
            secret.plans("push", progress=False)
    assert "(the key)" in caplog.text
    assert SECRET not in caplog.text
    assert "a-password-of-mine" not in caplog.text


def test_what_an_address_hides_is_hidden(tmp_path):
    said = "a-password-of-mine, http://me:a-password%2Dof-mine@x/, "
    said += f"Basic {b64encode(b'me:a-password-of-mine').decode()}"
    with serving(FakeServer(lambda _: completion(said))) as address:
        secret = address.replace("http://", "http://me:a-password%2Dof-mine@")
        (answer,) = planner(secret, tmp_path).plans("push", out=tmp_path / "out", progress=False)
    assert answer.text.count("(the key)") == 3
    texts = [repr(answer), *(path.read_text() for path in tmp_path.rglob("*") if path.is_file())]
    assert not [text for text in texts if "password" in text or "cGFzc3dvc" in text]


@settings(max_examples=80, deadline=None)
@given(st.text(max_size=60), st.text(max_size=60))
def test_a_text_without_a_key_stays_as_it_is(before, behind):
    hide = Redactor([SECRET, "", "a", "none", "EMPTY"])
    assert hide(before) == before or "none" in before or "EMPTY" in before
    found = hide(before + " " + SECRET + " " + behind)
    assert not known(found)
    assert "(the key)" in found


@pytest.mark.parametrize(
    ("key", "text", "found"),
    [
        ("none", "if none of Nonesuch is nonetheless none.", "if (the key) of Nonesuch is nonetheless (the key)."),
        ("x", "x is x", "x is x"),
        ("not-needed", "it is Not needed", "it is (the key)"),
        ("sk-12", "sk-12, SK-12", "(the key), SK-12"),
    ],
)
def test_a_short_key_is_hidden_where_it_stands_alone(key, text, found):
    assert Redactor([key])(text) == found


def test_accents_without_end_take_no_time():
    hide, marks = Redactor([SECRET]), "a" + "\u0300\u0316" * 100_000  # sorted pair by pair they take a minute
    begun = time.process_time()
    assert hide(marks) == marks
    assert hide(marks + SECRET) != marks + SECRET
    assert time.process_time() - begun < 10


def test_no_shipped_plan_holds_what_people_write_for_a_key():
    words = [
        "EMPTY",
        "none",
        "None",
        "ollama",
        "lm-studio",
        "sk-no-key-required",
        "not-needed",
        "token-abc123",
        "dummy",
    ]
    hide = Redactor(words)
    for plan in PLANS.values():
        for format in lw.PLAN_FORMATS:
            text = lw.encode_plan(plan, format)
            assert hide(text) == text


def test_a_key_that_no_header_can_hold_is_refused(tmp_path, monkeypatch):
    for key in ("sk-\u20ac9876543", "sk-98765\n43210"):
        monkeypatch.setenv("OPENAI_API_KEY", key)
        with pytest.raises(lw.planners.PlannerError, match="the key in OPENAI_API_KEY has characters") as caught:
            planner("http://127.0.0.1:1/v1", tmp_path).plans("push", progress=False)
        assert "9876" not in str(caught.value)
