"""``lw-torchrl plan``: prompts, generation, parsing and repair of plans."""

import re

import pytest
from cases import read_cases
from commands import document, fails, run
from fake_server import FakeServer, asked_for, completion, error, serving, shipped

import lw_torchrl as lw

TEXTS = read_cases("cli/texts.toml")


def test_prompt_equals_that_of_plan_prompt(capsys):
    printed = run(capsys, "plan", "prompt", "drawer-open", "--format", "chain_py")
    assert printed == lw.planners.plan_prompt("drawer-open", "chain_py")
    printed = run(capsys, "plan", "prompt", "push", "--format", "goal_md", "--vocabulary", "--plans", "MT50")
    assert printed == lw.planners.plan_prompt("push", "goal_md", vocabulary=True, plans=lw.load_plans("MT50"))


def test_a_plan_in_own_words_can_be_scripted(capsys, tmp_path):
    file = tmp_path / "mine" / "push.plan"
    file.parent.mkdir()
    file.write_text('def push(robot):\n    if check("the gripper is open"):\n        robot.hover("over the puck")\n')
    evaluate = ["evaluate", "scripted", "--episodes", 1, "--max-steps", 2, "--plans"]
    error = fails(capsys, *evaluate, file.parent)
    near = "place the gripper above the puck"
    assert f"{file}: no scripted skill for step 1 'hover over the puck' (nearest: '{near}')" in error
    assert f"plan read {file} --scripted --out" in error
    run(capsys, "plan", "read", file, "--scripted", "--out", tmp_path / "scripts")
    assert near in run(capsys, *evaluate, tmp_path / "scripts")


def test_read_prints_the_tree_of_a_program(capsys, tmp_path):
    file = tmp_path / "push.py"
    file.write_text(TEXTS["program"])
    printed = run(capsys, "plan", "read", file)
    tree = [re.split(r"(?<=\S) {2,}", line.rstrip())[0] for line in printed.splitlines()]
    assert tree[2:9] == TEXTS["tree"].splitlines()
    assert "left out: 'dance wildly': no query is near enough" in printed
    assert "line 2: 'attempts += 1' is left out" in printed
    assert "\x1b" not in printed
    assert "happy \\x1b[31m" in printed
    shown = document(capsys, "plan read", file)
    paths = {step["written"]: (step["line"], step["path"]) for step in shown["read"] if step["written"]}
    assert paths["close the gripper"] == (7, ["if gripper near puck", "else"])
    assert paths["dance wildly"] == (9, [])
    assert any("attempts += 1" in note for note in shown["plans"][0]["notes"])


def test_plans_of_another_suite_are_read_and_checked(capsys, tmp_path):
    file = tmp_path / "mine.plan"
    file.write_text(TEXTS["fetch"])
    assert "mine.plan: 1 step, valid" in run(capsys, "check", file)
    assert "fetch/push" in run(capsys, "plan", "read", file)
    read = {plan["task"] for plan in document(capsys, "plan read", "fetch")["plans"]}
    assert read == {*lw.suites.SUITES["fetch"].tasks}


@pytest.mark.parametrize("format", lw.PLAN_FORMATS)
def test_read_parses_answers_of_language_models(capsys, tmp_path, format):
    plan = lw.load_plans("MT10")["reach"]
    answer = tmp_path / format / "reach-2.txt"
    answer.parent.mkdir()
    answer.write_text(lw.encode_plan(plan, format))
    shown = document(capsys, "plan read", answer)
    (summary,) = shown["plans"]
    assert (summary["task"], summary["source"]) == ("reach", "plan")
    assert [step["written"] for step in shown["read"]] == [step.skill for step in plan.steps]
    answer.with_name("push-0.txt").write_text("I cannot help with that.")
    printed = run(capsys, "plan", "read", *answer.parent.iterdir(), "--out", tmp_path / "mine")
    assert "push-0.txt: no plan can be read: " in printed
    steps = lw.load_plans(tmp_path / "mine")["reach"].steps
    assert [(step.condition, step.skill) for step in steps] == [(step.condition, step.skill) for step in plan.steps]
    assert "no plan can be read" in fails(capsys, "plan", "read", answer.with_name("push-0.txt"))


@pytest.fixture(autouse=True)
def _no_key(monkeypatch):
    for name in ("OPENAI_API_KEY", "OPENAI_BASE_URL"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("NO_PROXY", "*")


def generate(address, folder, *more):
    where = ("--out", folder / "plans", "--cache", folder / "kept")
    return ("plan", "generate", *more, "--model", "a/model", "--base-url", address, "--attempts", 2, *where)


def table(printed):
    """Return the rows of the printed table, by task and format."""
    cells = [line.split() for line in printed.splitlines()]
    return {tuple(row[:2]): row[2:] for row in cells if row[:1] in (["push"], ["reach"])}


def test_generate_writes_answers_and_counts_valid_plans(capsys, tmp_path):
    server = FakeServer(
        lambda body: completion("I will not", "length") if asked_for(body) == "reach" else shipped(body)
    )
    with serving(server) as address:
        command = generate(address, tmp_path, "push", "reach", "--format", "chain_py", "basic_md")
        first, second = run(capsys, *command), run(capsys, *command)
        shown = document(capsys, "plan generate", *command[2:])
        constrained = run(capsys, *generate(address, tmp_path, "push", "--format", "basic_py", "--constrain"))
    assert shown["notes"] == [{"note": "the answer was cut off at max_tokens", "answers": 4}]
    rows = table(first)
    assert rows["push", "chain_py"] == ["2", "2", "2", "2", "200", "20"]
    assert rows["reach", "basic_md"] == ["2", "0", "0", "2", "200", "20"]
    assert "4 answers: the answer was cut off at max_tokens" in first
    assert f"880 tokens; written to {tmp_path / 'plans' / 'a_model'}" in first
    again = table(second)
    assert again["push", "chain_py"] == ["2", "2", "2", "0", "200", "20"]
    assert len(server.requests) == 10
    plan = lw.load_plans("MT10")["push"]
    assert (tmp_path / "plans/a_model/chain_py/push-1.py").read_text() == lw.encode_plan(plan, "chain_py")
    assert "a_model-constrained" not in first
    assert (tmp_path / "plans/a_model-constrained/basic_py/push-0.json").exists()
    assert "220 tokens" in constrained


def test_errors_of_generate_are_one_line(capsys, tmp_path):
    with serving(FakeServer(lambda body: error(404, "no such model"))) as address:
        assert "a/model" in fails(capsys, *generate(address, tmp_path, "push"))
    assert "push" in fails(capsys, *generate("http://x/v1", tmp_path, "psuh"))
    assert "--format must be one of" in fails(capsys, *generate("http://x/v1", tmp_path, "push", "--format", "chain"))
    assert "OPENAI_API_KEY" in fails(capsys, "plan", "generate", "push", "--model", "m", "--cache", tmp_path / "kept")


def test_repair_asks_again_and_shows_the_success_of_each_round(capsys, tmp_path):
    def learns(body):
        is_repair = any(message["role"] == "assistant" for message in body["messages"])
        return shipped(body) if is_repair else completion("I would rather", "length")

    with serving(FakeServer(learns)) as address:
        where = ("--out", tmp_path / "plans", "--cache", tmp_path / "kept", "--episodes", 1)
        command = ("plan", "repair", "reach", "--model", "m", "--base-url", address, "--rounds", 2, *where)
        printed = run(capsys, *command)
        shown = document(capsys, "plan repair", *command[2:])
    assert shown["plans"] == [{"task": "reach", "attempt": 0, "success": [0.0, 1.0]}]
    assert ["reach", "0", "0%", "100%"] in [line.split() for line in printed.splitlines()]
    assert "1 answer: the answer was cut off at max_tokens" in printed
    assert (tmp_path / "plans/m-round1/chain_py/reach-0.py").is_file()


def test_repair_reuses_the_answers_of_generate(capsys, tmp_path):
    server = FakeServer(lambda body: completion(f"I cannot, for the {len(server.requests)}th time."))
    where = ("--out", tmp_path / "plans", "--cache", tmp_path / "kept", "--model", "m")
    with serving(server) as address:
        run(capsys, "plan", "generate", "reach", "--base-url", address, "--seed", 7, *where)
        text = (tmp_path / "plans/m/chain_py/reach-0.py").read_text()
        repair = ("plan", "repair", "reach", "--base-url", address, "--episodes", 1, "--rounds", 1, *where)
        printed = run(capsys, *repair, "--seed", 7)
        assert len(server.requests) == 2
        assert server.requests[1]["messages"][2]["content"] == text
        assert "1 first answer, 0 requested now" in printed
        assert printed.endswith(f"written to {tmp_path / 'plans/m'}, {tmp_path / 'plans/m-round1'}\n")
        assert "seed (7, now None)" in fails(capsys, *repair)
