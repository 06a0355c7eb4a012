"""Answers that are kept: what is written reads back as it was, and what would not is not written."""

import json

import pytest
from fake_server import PLANS, FakeServer, completion, planner, serving
from hypothesis import given, settings
from hypothesis import strategies as st

import lw_torchrl as lw
from lw_torchrl.planners.answer_files import AnswerCache
from lw_torchrl.planners.answers import Reply, Tokens

pytestmark = pytest.mark.usefixtures("no_account")


TEXT = st.text(max_size=20) | st.sampled_from(["\ud800", "a\x00b", "\ufeff\r", "x" * 100])
COUNT = st.integers() | st.floats() | st.booleans() | st.none() | st.just(10**4000)
ANYTHING = TEXT | COUNT
DEEP_LIST = [0]
for _ in range(900):
    DEEP_LIST = [DEEP_LIST]
REQUEST = st.fixed_dictionaries({"model": TEXT, "options": ANYTHING | st.just(DEEP_LIST) | st.just([[DEEP_LIST] * 2])})


@settings(max_examples=60, deadline=None)
@given(REQUEST, st.builds(Reply, ANYTHING, ANYTHING, TEXT, st.builds(Tokens, COUNT, COUNT), st.tuples(ANYTHING)))
def test_what_is_written_can_be_read_and_the_rest_is_not_written(tmp_path_factory, request_, reply):
    cache = AnswerCache(tmp_path_factory.mktemp("kept"))
    try:
        cache.write(request_, reply)
    except ValueError:
        written = False
    else:
        written = cache.read(request_) == reply
    assert written == bool(list(cache.folder.rglob("*")))


def test_a_text_that_is_too_large_is_not_written(tmp_path):
    with pytest.raises(ValueError, match="cannot be kept: it is larger than"):
        AnswerCache(tmp_path).write({}, Reply("\u00e9" * 6_000_000))
    assert not list(tmp_path.iterdir())


def test_an_answer_that_cannot_be_kept_is_given_with_a_note(tmp_path, monkeypatch):
    monkeypatch.setattr("lw_torchrl.planners.answer_files.JSON_LIMIT", 10)
    with serving(FakeServer()) as address:
        (answer,) = planner(address, tmp_path).plans("push", progress=False)
    assert answer.decoded.plan == PLANS["push"]
    assert answer.notes == ("the answer cannot be kept: it is larger than 10 bytes",)


def test_a_file_of_a_hostile_answer_is_asked_for_again(tmp_path):
    with serving(FakeServer()) as address:
        own = planner(address, tmp_path)
        own.plans("push", progress=False)
        (kept,) = (tmp_path / "kept").rglob("*.json")
        good = kept.read_text()
        text = json.loads(good)["answer"]["text"]
        for bad in (
            good.replace(json.dumps(text), '"\\ud800"'),
            good.replace('"notes": []', '"notes": [3]'),
            "[" * 200_000,
        ):
            kept.write_text(bad)
            (answer,) = own.plans("push", out=tmp_path / "out", progress=False)
            assert answer.notes[0].startswith("it was asked for again, since the kept answer")
            assert kept.read_text() == good


@pytest.mark.parametrize("text", ["\ufeffno", "one\r\ntwo\rthree", "half \ud800", "\x00\x85\u2028", "a\ufeffb\r\n"])
def test_a_text_reads_from_its_file_as_it_was_given(tmp_path, text):
    out = {"out": tmp_path / "out", "progress": False}
    with serving(FakeServer(lambda _: completion(text))) as address:
        asked = planner(address, tmp_path)
        (first,) = asked.plans("push", **out)
        facts = ["try again"]
        (again,) = asked.revise([first], facts, **out)
        (third,) = asked.revise([first], facts, **out)  # a text of another reading would be refused
    assert third.text == again.text
    (read,) = lw.FilePlanner(tmp_path / "out", "m").plans("push")
    assert (read.text, read.raw) == (first.text, first.raw)
    row = {"llm": "x", "format": "chain_py", "task": "push", "attempt": 0, "completion": text}
    (tmp_path / "rows.jsonl").write_text(json.dumps(row))
    (row_read,) = lw.FilePlanner(tmp_path / "rows.jsonl").plans("push", out=tmp_path / "copy")
    assert row_read.text == first.text
    assert lw.FilePlanner(tmp_path / "copy").plans("push")[0].text == first.text
