"""``lw-torchrl plan``: the prompt that asks a language model for a plan."""

import pytest
from commands import fails, run

import lw_torchrl as lw
from lw_torchrl.cli.main import main
from lw_torchrl.cli.plan import COMMANDS


def test_prompt_prints_what_plan_prompt_gives(capsys):
    assert run(capsys, "plan", "prompt", "drawer-open", "--format", "chain_py") == lw.plan_prompt(
        "drawer-open", "chain_py"
    )
    printed = run(capsys, "plan", "prompt", "push", "--format", "goal_md", "--vocabulary", "--plans", "MT50")
    assert printed == lw.plan_prompt("push", "goal_md", vocabulary=True, plans=lw.load_plans("MT50"))


def test_it_names_its_commands_and_they_explain_themselves(capsys):
    for command in ([], *([name] for name in COMMANDS)):
        with pytest.raises(SystemExit) as caught:
            main(["plan", *command, "--help"])
        assert caught.value.code == 0
        printed = capsys.readouterr().out
        assert all(name in printed for name in (command or COMMANDS))
    with pytest.raises(SystemExit) as caught:
        main(["plan", "dance"])
    assert caught.value.code == 2


def test_errors_are_in_its_words(capsys):
    assert "error: --format must be one of" in fails(capsys, "plan", "prompt", "reach", "--format", "chain")
    assert "drawer-open" in fails(capsys, "plan", "prompt", "drawer-opne")
    assert "--plans must name" in fails(capsys, "plan", "prompt", "reach", "--plans")
