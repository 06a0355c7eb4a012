"""nearest_query: any text matches a query of the task, and a query matches itself."""

import statistics
from dataclasses import replace

import pytest
from cases import read_cases
from hypothesis import example, given, settings
from hypothesis import strategies as st
from speed import within

from lw_torchrl.language import nearest
from lw_torchrl.language.expressions import leaves
from lw_torchrl.language.nearest import _JOINS, nearest_query
from lw_torchrl.language.queries import QueryError, parse_query, split_words, supported_queries
from lw_torchrl.language.tasks import MT50

CASES = read_cases("language/queries.toml")
tasks = st.sampled_from(MT50)
WORDS = sorted({
    word for task in ("drawer-open", "stick-pull", "door-lock") for text in supported_queries(task)
    for word in text.split()
} | {"a", "and", "but", "isn't", "doesn't", "never", "hand", "?", ",", "does", "over", "puck", "’", "AND",
     "or", "nor", "unless", "either", "neither", "both", "(", ")", "always"})  # fmt: skip
any_text = st.text(st.characters()) | st.lists(st.sampled_from(WORDS), max_size=25).map(" ".join)


@example("", "push")
@example("and", "push")
@example("and and and", "push")
@example("not", "push")
@example("?!", "push")
@example("\ud800", "push")
@example("\x00 and \x00", "push")
@example("x" * 100_000, "stick-pull")
@example("İs the gripper open", "reach")
@settings(max_examples=160, deadline=None)
@given(any_text, tasks)
def test_any_text_has_a_nearest_query(text, task):
    match = nearest_query(text, task)
    assert 0.0 <= match.score <= 1.0
    assert parse_query(str(match.query), task) == match.query
    assert match.parts
    clauses = [clause for part in match.parts for clause in part.query.clauses]
    if _JOINS.isdisjoint(split_words(text.casefold())):
        assert tuple(clauses) == match.query.clauses
    assert {replace(clause, negated=False) for clause in clauses}.issuperset(leaves(match.query.expression))
    assert all(0.0 <= part.score <= 1.0 for part in match.parts)
    assert match.score == pytest.approx(statistics.mean(part.score for part in match.parts))
    try:
        assert match.query == parse_query(text, task)
        assert match.score == 1.0
    except QueryError:
        pass


@settings(max_examples=80, deadline=None)
@given(st.data(), tasks)
def test_a_query_matches_itself_also_if_it_is_misspelt(data, task):
    picked = data.draw(st.lists(st.sampled_from(supported_queries(task)), min_size=1, max_size=3))
    match = nearest_query(" and ".join(picked), task)
    assert (str(match.query), match.score) == (" and ".join(picked), 1.0)
    assert [str(part.query) for part in match.parts] == picked
    meant = data.draw(st.sampled_from([text for text in supported_queries(task) if " above " in text]))
    match = nearest_query(
        meant.replace("above", data.draw(st.sampled_from(["abov", "abbove", "aboove", "abve"]))), task
    )
    assert str(match.query) == meant
    assert 0.8 < match.score < 1.0


@pytest.mark.parametrize(("text", "task", "expected"), CASES["nearest"])
def test_free_form_conditions(text, task, expected):
    match = nearest_query(text, task)
    assert str(match.query) == expected
    assert 0.5 < match.score < 1.0


@pytest.mark.parametrize("by", ["edit", "embedding"])
@pytest.mark.parametrize(("text", "negated"), CASES["negations"])
def test_a_negation_matches_a_negation(text, negated, by):
    query = nearest_query(text, "push", by=by).query
    assert [(clause.predicate, clause.negated) for clause in query.clauses] == [("above", negated)]


def test_each_part_has_its_match():
    first, second = nearest_query("the gripper is open and  not abov the puck", "push").parts
    assert (first.text, str(first.query), first.score) == ("the gripper is open", "the robot's gripper is open", 1.0)
    assert (second.text, str(second.query)) == ("not abov the puck", "the robot's gripper is not above the puck")
    assert 0.5 < second.score < 1.0


def test_an_embedding_matches_the_meaning_and_a_task_s_queries_are_encoded_once(monkeypatch):
    sizes = []
    encode = nearest.sentence_vectors
    monkeypatch.setattr(nearest, "sentence_vectors", lambda texts: sizes.append(len(texts)) or encode(texts))
    nearest._vectors.cache_clear()
    match = nearest_query("Has the gripper arrived at the reach target?", "reach", by="embedding")
    assert str(match.query) == "the robot's gripper is near the reach target"
    assert 0.3 < match.score < 1.0
    for text in ("the goal was reached", "", "\ud800", "and", "the gripper is open and where it should be"):
        again = nearest_query(text, "reach", by="embedding")
        assert parse_query(str(again.query), "reach") == again.query
        assert 0.0 <= again.score <= 1.0
    assert sum(size > 1 for size in sizes) == 1
    sizes.clear()
    assert nearest_query("gripper open", "reach", by="embedding").score == 1.0
    assert not sizes, "a query needs no text model"


def test_searches_are_fast():
    longest = max(MT50, key=lambda task: len(supported_queries(task)))
    nearest_query("the gripper touches the puck", longest)
    with within(0.2):
        for _ in range(20):
            nearest_query("the gripper touches the puck", longest)
    for text in ("x" * 200_000, "and " * 50_000, "the gripper is open and " * 63 + "moon " * 40_000, "not " * 50_000):
        with within(5):
            nearest_query(text, "stick-pull")


@pytest.mark.parametrize(("text", "nearest_text"), CASES["nearest_connectives"])
def test_connectives(text, nearest_text):
    assert nearest_query(text, "push").query == parse_query(nearest_text, "push")
