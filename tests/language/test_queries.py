"""The query language: every spelling, the published list, and errors that point at a word and name the nearest."""

import pickle
import re
from copy import deepcopy

import language_world as oracle
import pytest
from cases import read_cases
from conditions import query_of, text_of, tower, trees
from hypothesis import example, given, settings
from hypothesis import strategies as st
from speed import within

from lw_torchrl.language.expressions import any_of, count_mentions
from lw_torchrl.language.nearest import nearest_query
from lw_torchrl.language.objects import GRIPPER, NamedObject
from lw_torchrl.language.queries import (
    ARTICLES,
    Clause,
    Query,
    QueryError,
    check_query,
    parse_query,
    read_query,
    supported_queries,
)
from lw_torchrl.language.relations import RELATIONS, TOUCHING
from lw_torchrl.language.tasks import MT50, TASKS, Task, get_task

CASES = read_cases("language/queries.toml")
tasks = st.sampled_from(MT50)


@st.composite
def clauses(draw, task):
    names = get_task(task).object_names
    first = draw(st.sampled_from(names))
    negated = draw(st.booleans())
    kinds = ["relation", TOUCHING] + (["open", "closed"] if first == GRIPPER else [])
    kind = draw(st.sampled_from(kinds))
    if kind != "relation":
        return Clause(first, kind, negated=negated)
    second = draw(st.sampled_from([name for name in names if name != first]))
    return Clause(first, draw(st.sampled_from(sorted(RELATIONS))), second, negated)


@st.composite
def spelled(draw):
    """A task, a query, and one of the accepted spellings of the query."""
    task = draw(tasks)
    query = Query(tuple(draw(st.lists(clauses(task), min_size=1, max_size=4))))

    def noun(name):
        forms = [name, "gripper", "robot gripper", "Robot’s gripper"] if name == GRIPPER else [name]
        article = draw(st.sampled_from(["", *(f"{a} " for a in ARTICLES)]))
        return article + draw(st.sampled_from(forms))

    parts = []
    previous = None
    for clause in query.clauses:
        tail = clause.predicate if clause.object is None else f"{clause.predicate} {noun(clause.object)}"
        subject = "" if clause.subject == previous and draw(st.booleans()) else f"{noun(clause.subject)} "
        if clause.negated:
            negations = [f"{subject}is not {tail}", f"{subject}isn't {tail}", f"{subject}not {tail}"]
            questions = [f"is {subject}not {tail}", f"isn't {subject}{tail}"]
        else:
            negations, questions = [f"{subject}is {tail}", f"{subject}{tail}"], [f"is {subject}{tail}"]
        parts.append(draw(st.sampled_from(negations + questions)))
        previous = clause.subject
    text = " and ".join(parts)
    text = draw(st.sampled_from([text, text.capitalize(), text.upper(), text.title(), text.replace("'", "’")]))
    text = draw(st.sampled_from(["", " ", "\n\t"])) + text + draw(st.sampled_from(["", "?", " ?", ".", "  ", "?\n"]))
    return (task, query, draw(st.sampled_from([text, text.replace(" ", "  "), text.replace(" and ", "\n and\t")])))


def without_articles(text):
    return " ".join(word for word in text.split() if word != "the")


@settings(max_examples=120, deadline=None)
@given(spelled())
def test_every_spelling_parses_to_the_same_query(drawn):
    task, query, text = drawn
    assert parse_query(text, task) == parse_query(str(query), TASKS[task]) == query
    assert str(parse_query(str(query), task)) == str(query)


@pytest.mark.parametrize(("text", "canonical"), CASES["spellings"])
def test_spellings(text, canonical):
    assert str(parse_query(text, task="pick-place")) == canonical


@pytest.mark.parametrize("task", MT50)
def test_the_supported_queries_are_the_published_ones(task):
    ours, published = supported_queries(task, published_only=True), oracle.enumerate_base_queries(task)
    assert len(ours) == len(set(ours)) == len(published)
    assert {without_articles(text) for text in ours} == {without_articles(text) for text in published}
    for text in ours:
        assert str(parse_query(text, task)) == text, "canonical, 'the' before every noun"
    for text in published:
        assert without_articles(str(parse_query(text, task))) == without_articles(text)


def test_around_is_listed_only_with_the_gripper_first_but_parsed_either_way():
    assert "the robot's gripper is around the puck" in supported_queries("push")
    assert "the puck is around the robot's gripper" not in supported_queries("push")
    assert str(parse_query("puck around gripper", "push")) == "the puck is around the robot's gripper"
    assert "the target location is touching the table" not in supported_queries("push")
    assert str(parse_query("target location touching the table", "push")) == "the target location is touching the table"
    assert str(parse_query("the gripper isn't touching the table", "push")) == (
        "the robot's gripper is not touching the table"
    )


VOCABULARY = sorted({
    word
    for task in ("drawer-open", "stick-pull", "door-lock")
    for text in supported_queries(task)
    for word in text.split()
} | {"a", "an", "and", "isn't", "gripper", "robot", "?", "or", "puck", ",", "’", "isn’t", "AND"})  # fmt: skip
any_text = st.text(st.characters())
word_salad = st.lists(st.sampled_from(VOCABULARY), max_size=25).map(" ".join)


@example("", "reach")
@example("and", "reach")
@example(" and and ", "reach")
@example("is", "reach")
@example("isn't", "reach")
@example("the", "reach")
@example("gripper open and", "reach")
@example("and gripper open", "reach")
@example("\ud800", "reach")
@example("\x00", "reach")
@example("İs the gripper open", "reach")
@settings(max_examples=120, deadline=None)
@given(any_text | word_salad, tasks)
def test_any_text_is_a_query_or_a_query_error(text, task):
    if (query := read_query(text, TASKS[task])) is not None:
        assert parse_query(str(query), task) == parse_query(text, task) == query
        return
    with pytest.raises(QueryError) as caught:
        parse_query(text, task)
    assert any(f"nearest query is {listed!r}" in str(caught.value) for listed in supported_queries(task))


DEEP = "(" * 256 + "gripper open" + ")" * 255
LONG = ["the gripper is open and " * 8_000 + "moon", "the gripper is above the stick and not " * 4_000 + "flying", DEEP]


@pytest.mark.parametrize("text", [*(word * 200_000 for word in ("x", "the ", "and ", "(", "either ", " ", "?")), *LONG])
def test_a_very_long_text_fails_in_time(text):
    with within(5), pytest.raises(QueryError):
        parse_query(text, "stick-pull")


def test_a_query_has_at_most_256_clauses():
    assert len(parse_query("the gripper is open" + " and not above the stick" * 255, "stick-pull").clauses) == 256
    with pytest.raises(QueryError, match="at most 256 clauses, got 257"):
        parse_query("the gripper is open" + " or not above the stick" * 256, "stick-pull")
    assert len(nearest_query("grip open" + " and no above stick" * 255, "stick-pull").query.clauses) == 256
    with pytest.raises(QueryError, match="at most 256 clauses, got 257"):
        nearest_query("grip open" + " and no above stick" * 256, "stick-pull")


def test_an_expression_of_exponential_length_is_refused_in_time():
    with within(1):
        tip = tower("stick-pull")
        assert count_mentions(tip) > 10**9
        with pytest.raises(QueryError, match="at most 256 clauses"):
            check_query(Query(tip), "stick-pull")


@pytest.mark.parametrize(("text", "canonical"), CASES["connectives"])
def test_connectives(text, canonical):
    words = {"O": "is open", "A": "is above the puck", "N": "is near the puck"}
    for letter, spelled in words.items():
        canonical = re.sub(rf"\bnot {letter}\b", f"the robot's gripper {spelled.replace('is', 'is not', 1)}", canonical)
        canonical = re.sub(rf"\b{letter}\b", f"the robot's gripper {spelled}", canonical)
    query = parse_query(text, "push")
    assert str(query) == canonical
    assert parse_query(canonical, "push") == query


@settings(max_examples=150, deadline=None)
@given(st.data(), tasks)
def test_a_condition_is_read_as_it_is_written(data, task):
    tree = data.draw(trees(st.sampled_from(supported_queries(task)[:20])))
    query = query_of(tree, task)
    assert parse_query(text_of(tree), task) == query
    assert parse_query(str(query), task) == query
    assert str(parse_query(str(query), task)) == str(query)
    assert nearest_query(str(query), task).query == query
    assert check_query(query, task) is query


def test_clauses_and_implied_clauses():
    text = "gripper near puck and (gripper closed and below puck or gripper closed and not above puck)"
    query = parse_query(text, "push")
    assert not query.is_conjunction
    assert query.implied == (Clause(GRIPPER, "near", "puck"), Clause(GRIPPER, "closed"))
    other = parse_query("gripper near puck or gripper closed and not above puck", "push")
    assert (other.implied, len(other.clauses), other.clauses[-1].negated) == ((), 3, True)
    plain = parse_query("gripper open and gripper open", "push")
    assert plain.is_conjunction
    assert plain == parse_query("gripper open", "push")
    assert str(plain) == "the robot's gripper is open and the robot's gripper is open"


@pytest.mark.parametrize("copy", [deepcopy, lambda query: pickle.loads(pickle.dumps(query))])
def test_copies_of_queries_are_equal(copy):
    for text in ("gripper open or near puck", "gripper open and open", "always"):
        query = parse_query(text, "push")
        assert (copy(query), str(copy(query)), hash(copy(query))) == (query, str(query), hash(query))


@pytest.mark.parametrize(("text", "task", "at", "expected", "near"), CASES["errors"])
def test_an_error_points_at_the_word_and_names_the_nearest(text, task, at, expected, near):
    with pytest.raises(QueryError) as caught:
        parse_query(text, task)
    for part in (f"at {at}", expected, repr(text), repr(task), f"nearest query is {near!r}" if near else ""):
        assert part in str(caught.value)


@settings(max_examples=40, deadline=None)
@given(st.text(min_size=300, max_size=2000) | st.lists(st.sampled_from(VOCABULARY), min_size=60).map(" ".join), tasks)
def test_an_error_quotes_little_of_a_long_text(text, task):
    with pytest.raises(QueryError) as caught:
        parse_query(text + " flying", task)
    # Control characters are written in up to ten.
    assert len(ascii(str(caught.value))) < 3000
    assert text not in str(caught.value)


def test_a_query_is_checked_against_its_task():
    query = parse_query("the gripper is above the puck", "push")
    assert check_query(query, "push") == check_query("gripper above puck", "push") == query
    with pytest.raises(QueryError, match="drawer handle"):
        check_query(query, "drawer-open")
    clauses = [
        ("puck", "flying"),
        ("puck", "near"),
        (GRIPPER, "open", "puck"),
        ("puck", "open"),
        ("puck", "near", "puck"),
    ]
    wrong = [Query((Clause(*parts),)) for parts in clauses]
    for each in (*wrong, Query(any_of([query.expression, Clause("duck", "near", "puck")]))):
        with pytest.raises(QueryError):
            check_query(each, "push")


words = st.sampled_from(
    ["a", "an", "isn't", "open", "near", "above", "gripper", "robot", "touching", "box", "lid", "x-1"]
)
own_names = st.lists(words, min_size=1, max_size=3).map(" ".join)


@settings(max_examples=80, deadline=None)
@given(data=st.data(), names=st.lists(own_names.filter(lambda n: n != GRIPPER), min_size=1, max_size=4, unique=True))
def test_the_objects_of_a_custom_task_may_have_any_allowed_name(data, names):
    named = (NamedObject(GRIPPER, (0, 1, 2)), *(NamedObject(name, (4, 5, 6)) for name in names))
    task = Task("mine", "Mine.", named)
    query = Query(tuple(data.draw(st.lists(clauses(task), min_size=1, max_size=3))))
    assert parse_query(str(query), task) == query
    assert all(str(parse_query(text, task)) == text for text in supported_queries(task))
