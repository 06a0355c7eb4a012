"""Text that others wrote is shown, and has no effect on a terminal or a page."""

import json
import os
import re
from contextlib import suppress

import pytest
from cases import read_cases
from commands import python_process
from hypothesis import example, given
from hypothesis import strategies as st

import lw_torchrl as lw
from lw_torchrl._util.text import markdown, printable
from lw_torchrl.cli.main import main

# Sequences that clear the screen, set the title, write to the clipboard, move the cursor or reverse the text.
SEQUENCES = "\x1b[2J \x1b]0;owned\x07 \x1b]52;c;eA==\x1b\\ \r \x08\x08 \x9b1A \u202e \u2066 \x7f"
EVIL = "\x1b]0;owned\x07\x1b[2J"


@given(st.text())
@example(SEQUENCES)
def test_printable_text_has_no_control_characters(text):
    shown = printable(text)
    assert not re.search(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]", shown)
    shown.encode()  # nothing is left that cannot be written
    assert printable(shown) == shown


@pytest.mark.parametrize("text", ["pick up the puck", "50 % — “ü”, μ ✓ →\n\tx", "日本語", "reach-v3", "C:\\demos"])
def test_usual_text_is_unchanged(text):
    assert printable(text) == text


@pytest.mark.parametrize("text", read_cases("links.toml")["links"])
@pytest.mark.parametrize("around", ["{}", "**→ {}**", "| {} | b |", "- x {}"])
def test_markdown_has_no_links_or_images(text, around):
    markdown_it = pytest.importorskip("markdown_it")
    parser = markdown_it.MarkdownIt("commonmark", {"html": True}).enable("table")
    page = "| a | b |\n|---|---|\n" * ("|" in around) + around.format(markdown(text))
    kinds = {token.type for block in parser.parse(page) for token in [block, *(block.children or [])]}
    assert not kinds & {"link_open", "image", "html_inline", "html_block", "code_inline", "fence"}
    texts = [token for block in parser.parse(page) for token in block.children or [] if token.type == "text"]
    assert " ".join(text.split()) in " ".join("".join(token.content for token in texts).split())
    # Autolinks of GitHub's Markdown need these signs unescaped.
    assert not re.search(r"\w://|www\.|\w@|mailto:\w+@", markdown(text))


def run(*args, **variables):
    return python_process("-W", "ignore::DeprecationWarning", "-m", "lw_torchrl", *args, **variables)


@pytest.mark.parametrize("command", [["plan", "read"], ["check"], ["plan", "read", "--json"]], ids=" ".join)
def test_commands_do_not_send_escape_sequences_of_a_plan(tmp_path, capsys, command):
    plan = lw.encode_plan(lw.load_plans("MT10")["reach"], "basic_py")
    lines = plan.splitlines()
    (tmp_path / "reach-0.py").write_text("\n".join([f"# {EVIL} note", *lines, f'    robot.move("{EVIL} somewhere")']))
    (tmp_path / "reach.plan").write_text("\n".join([*lines, f'    robot.move("{EVIL} somewhere")']))
    source = ["reach-0.py", "--task", "reach", "--format", "basic_py"] if command[0] == "plan" else ["reach.plan"]
    with suppress(SystemExit):  # the plan has a fault
        main([*[word for word in command if word != "--json"], str(tmp_path / source[0]), *source[1:], *command[2:]])
    ran = capsys.readouterr()
    assert not {"\x1b", "\x07"} & {*ran.out, *ran.err}
    assert ran.out


@pytest.mark.parametrize("name", [f"no{EVIL}such", "a\u202eb.plan", "x\r\x1b[1Ay"])
def test_commands_do_not_send_escape_sequences_of_an_argument(capsys, name):
    for command in (["evaluate"], ["info"], ["check"], ["data", "show"], ["view"], ["tasks"], ["plan", "read"], []):
        with pytest.raises(SystemExit) as caught:
            main([*command, name])
        assert caught.value.code == 2
        ran = capsys.readouterr()
        assert printable(ran.out + ran.err) == ran.out + ran.err


LOUD = """
import atexit, os, subprocess, sys
print("printed")
sys.__stdout__.write("unflushed")
os.write(1, b"written")
subprocess.run(["echo", "from a child"])
atexit.register(print, "at exit")
"""


def test_json_is_one_document_whatever_an_imported_module_prints(tmp_path):
    (tmp_path / "loud.py").write_text(LOUD)
    for args in (["--import", "loud", "tasks", "reach"], ["tasks", "reach", "--import=loud"]):
        ran = run(*args, "--json", PYTHONPATH=f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
        assert json.loads(ran.stdout)["task"]["task"] == "reach"
        for words in ("printed", "unflushed", "written", "from a child", "at exit"):
            assert words in ran.stderr


def test_the_home_folder_is_expanded_in_options(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    plans = tmp_path / "home" / "plans"
    lw.save_plans(lw.Plans([lw.load_plans("MT10")["reach"]]), plans)
    main(["plan", "read", "~/plans", "--out=~/read"])
    assert [path.name for path in (tmp_path / "home" / "read").iterdir()] == ["reach.plan"]
