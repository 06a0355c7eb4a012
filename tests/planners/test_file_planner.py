"""FilePlanner: recorded answers in a folder, or in lines of JSON."""

import json

import pytest

import lw_torchrl as lw
from lw_torchrl.planners import answer_path, folder_name

PLANS = lw.load_plans("MT10")
STRAYS = ("notes.txt", "one/notes.md", "one/chain_md/push.md", "one/chain_md/push-0.json", ".x/chain_md/a-0.md")


@pytest.fixture
def folder(tmp_path):
    for model in ("one", "two/2"):
        for task in ("push", "drawer-open"):
            for attempt in (0, 1, 12):
                path = answer_path(tmp_path, model, "chain_md", task, attempt)
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(lw.encode_plan(PLANS[task], "chain_md") if attempt else "no")
    for stray in STRAYS:
        (tmp_path / stray).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / stray).write_text("?")
    return tmp_path


def test_answers_of_a_folder(folder, tmp_path):
    planner = lw.planners.FilePlanner(folder, "two/2")
    assert isinstance(planner, lw.planners.Planner)
    assert planner.name == "two_2"
    assert planner.recorded == tuple(("chain_md", task, k) for task in ("drawer-open", "push") for k in (0, 1, 12))
    answers = planner.plans(["push", "drawer-open"], format="chain_md", attempts=2, out=tmp_path / "copy")
    assert [(answer.task, answer.attempt, answer.cached) for answer in answers] == [
        ("drawer-open", 0, True), ("drawer-open", 1, True), ("push", 0, True), ("push", 1, True),
    ]  # fmt: skip
    assert [answer.decoded.plan for answer in answers] == [None, PLANS["drawer-open"], None, PLANS["push"]]
    (_, again) = lw.planners.FilePlanner(tmp_path / "copy").plans("push", format="chain_md", attempts=2)
    assert again.text == answers[3].text


def test_missing_answers(folder, tmp_path):
    planner = lw.planners.FilePlanner(folder, "one")
    missing = "no answer of 'one' is recorded for push in chain_md, attempt 2.*: 0, 1, 12"
    with pytest.raises(lw.planners.PlannerError, match=missing):
        planner.plans("push", format="chain_md", attempts=3)
    with pytest.raises(lw.planners.PlannerError, match=r"reach in chain_md, attempt 0.*none"):
        planner.plans("reach", format="chain_md")
    with pytest.raises(ValueError, match="several: one, two_2"):
        lw.planners.FilePlanner(folder)
    with pytest.raises(ValueError, match="model must be one of 'one', 'two_2', got 'tow'"):
        lw.planners.FilePlanner(folder, "tow")
    with pytest.raises(FileNotFoundError, match="nowhere"):
        lw.planners.FilePlanner(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="holds no answer files"):
        lw.planners.FilePlanner(tmp_path / "empty")


ROW = {"llm": "PaLM 2", "format": "basic_py", "task": "push", "attempt": 0, "completion": "x", "more": 1}


def test_lines_of_json(tmp_path):
    text = lw.encode_plan(PLANS["push"], "basic_py")
    rows = [{**ROW, "completion": text}, {**ROW, "attempt": 1}, {**ROW, "llm": "GPT"}]
    (tmp_path / "answers.jsonl").write_text("\n".join(json.dumps(row) for row in rows) + "\n\n")
    planner = lw.planners.FilePlanner(tmp_path / "answers.jsonl", "PaLM 2")
    assert planner.recorded == (("basic_py", "push", 0), ("basic_py", "push", 1))
    assert planner.plans("push", format="basic_py")[0].decoded.plan == PLANS["push"]


def test_broken_lines(tmp_path):
    for line, message in (
        ("[" * 10**5, "line 2: the line is not JSON"),
        (json.dumps({**ROW, "attempt": "0"}), "line 2: an answer needs the fields llm"),
        (json.dumps({**ROW, "format": "chain"}), "line 2: format must be one of"),
        (json.dumps({**ROW, "llm": "PaLM/2"}), "same folder 'PaLM_2'"),
    ):
        (tmp_path / "answers.jsonl").write_text(json.dumps({**ROW, "llm": "PaLM_2"}) + "\n" + line)
        with pytest.raises(ValueError, match=message):
            lw.planners.FilePlanner(tmp_path / "answers.jsonl")


@pytest.mark.parametrize("name", ["..", "/", "", "a/../b", "x" * 500, "ä ö", ".hidden", "con:stream?*"])
def test_a_model_s_name_is_a_folder_s(tmp_path, name):
    folder = folder_name(name)
    assert (tmp_path / folder).resolve().parent == tmp_path
    assert folder[0] != "."
    (tmp_path / folder).mkdir()
    assert folder_name(folder) == folder
