"""FilePlanner: recorded answers from a folder or from lines of JSON."""

import json
import os

import pytest

import lw_torchrl as lw
from lw_torchrl.planners import answer_path, folder_name

PLANS = lw.load_plans("MT10")


@pytest.fixture
def folder(tmp_path):
    for model in ("one", "two/2"):
        for task in ("push", "drawer-open"):
            for attempt in (0, 1, 12):
                path = answer_path(tmp_path, model, "chain_md", task, attempt)
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(lw.encode_plan(PLANS[task], "chain_md") if attempt else "no")
    for stray in (
        "notes.txt",
        "one/notes.md",
        "one/chain_md/push.md",
        "one/chain_md/push-0.json",
        ".x/chain_md/a-0.md",
    ):
        (tmp_path / stray).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / stray).write_text("?")
    return tmp_path


def test_a_folder(folder, tmp_path):
    planner = lw.FilePlanner(folder, "two/2")
    assert isinstance(planner, lw.planners.Planner)
    assert planner.name == "two_2"
    assert planner.recorded == tuple(("chain_md", task, k) for task in ("drawer-open", "push") for k in (0, 1, 12))
    found = planner.plans(["push", "drawer-open"], format="chain_md", attempts=2, out=tmp_path / "copy")
    assert [(answer.task, answer.attempt, answer.cached) for answer in found] == [
        ("drawer-open", 0, True), ("drawer-open", 1, True), ("push", 0, True), ("push", 1, True),
    ]  # fmt: skip
    assert [answer.decoded.plan for answer in found] == [None, PLANS["drawer-open"], None, PLANS["push"]]
    assert lw.FilePlanner(tmp_path / "copy").plans("push", format="chain_md", attempts=2)[1].text == found[3].text


def test_what_is_not_there(folder, tmp_path):
    planner = lw.FilePlanner(folder, "one")
    with pytest.raises(
        lw.planners.PlannerError, match=r"'one' is recorded for push in chain_md, attempt 2.* attempts 0, 1, 12"
    ):
        planner.plans("push", format="chain_md", attempts=3)
    with pytest.raises(
        lw.planners.PlannerError, match="reach in chain_md, attempt 0; of reach there are none in chain_md"
    ):
        planner.plans("reach", format="chain_md")
    with pytest.raises(ValueError, match="has answers of one, two_2"):
        lw.FilePlanner(folder)
    with pytest.raises(ValueError, match="model must be one of 'one', 'two_2', got 'tow'"):
        lw.FilePlanner(folder, "tow")
    with pytest.raises(FileNotFoundError, match="nowhere"):
        lw.FilePlanner(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="holds no answers"):
        lw.FilePlanner(tmp_path / "empty")
    (folder / "one/chain_md/push-0.md").write_bytes(b"\xff")
    with pytest.raises(ValueError, match="UTF-8"):
        planner.plans("push", format="chain_md")


ROW = {"llm": "PaLM 2", "format": "basic_py", "task": "push", "attempt": 0, "completion": "x", "more": 1}


def test_lines_of_json(tmp_path):
    text = lw.encode_plan(PLANS["push"], "basic_py")
    rows = [{**ROW, "completion": text}, {**ROW, "attempt": 1}, {**ROW, "llm": "GPT"}]
    (tmp_path / "answers.jsonl").write_text("\n".join(json.dumps(row) for row in rows) + "\n\n")
    planner = lw.FilePlanner(tmp_path / "answers.jsonl", "PaLM 2")
    assert planner.recorded == (("basic_py", "push", 0), ("basic_py", "push", 1))
    assert planner.plans("push", format="basic_py")[0].decoded.plan == PLANS["push"]


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("{", "line 2: it is no JSON"),
        ("[" * 10**5, "line 2: it is no JSON"),
        ("3", "line 2: an answer has llm"),
        (json.dumps({**ROW, "attempt": "0"}), "line 2: an answer has llm"),
        (json.dumps({**ROW, "attempt": True}), "line 2: an answer has llm"),
        (json.dumps({**ROW, "format": "chain"}), "line 2: format must be one of"),
    ],
    ids=range(6),
)
def test_lines_that_are_none(tmp_path, line, says):
    (tmp_path / "answers.jsonl").write_text(json.dumps(ROW) + "\n" + line)
    with pytest.raises(ValueError, match=says):
        lw.FilePlanner(tmp_path / "answers.jsonl")


def test_two_models_of_one_folders_name_are_not_taken_for_one(tmp_path):
    rows = [{**ROW, "llm": name} for name in ("a/b", "c", "a/b", "a_b")]
    (tmp_path / "answers.jsonl").write_text("\n".join(map(json.dumps, rows)))
    with pytest.raises(ValueError, match="line 4: the models 'a/b' and 'a_b' would both be 'a_b'"):
        lw.FilePlanner(tmp_path / "answers.jsonl", "c")


@pytest.mark.parametrize("name", ["..", "/", "", "a/../b", "x" * 500, "ä ö", ".hidden", "con:stream?*"])
def test_a_models_name_is_a_folders(tmp_path, name):
    found = folder_name(name)
    assert found
    assert (tmp_path / found).resolve().parent == tmp_path
    assert found[0] != "."
    (tmp_path / found).mkdir()
    assert folder_name(found) == found


def test_recorded_answers_of_three_models():
    path = os.environ.get("LW_TORCHRL_COMPLETIONS", "")
    if not path:
        pytest.skip("LW_TORCHRL_COMPLETIONS names no file of recorded answers")
    for model in ("PaLM 2", "GPT-3", "GPT-3.5"):
        planner = lw.FilePlanner(path, model)
        assert len(planner.recorded) == 72
        formats = sorted({format for format, _, _ in planner.recorded})
        assert formats == sorted(lw.PLAN_FORMATS)
        tasks = sorted({task for _, task, _ in planner.recorded})
        assert len(planner.plans(tasks, format="chain_py", attempts=2)) == 8
