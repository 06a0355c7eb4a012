"""Errors in a module of the user's: one line that says where, whatever was raised, in the user's own words."""

from __future__ import annotations

import importlib
import json
import sys

import pytest
from commands import fails

import lw_torchrl as lw
from lw_torchrl.cli import faults
from lw_torchrl.cli.faults import TRACEBACK, in_users_module, is_ours
from lw_torchrl.cli.main import COMMANDS, main
from lw_torchrl.cli.parsing import in_its_words

IMPORTED = {
    "raise ValueError('batch_size must be odd')\n": ":1: ValueError: batch_size must be odd, at `raise Val",
    "\n\n1 / 0\n": ":3: ZeroDivisionError: division by zero, at `1 / 0`",
    "import no_such_module\n": ":1: ModuleNotFoundError: No module named 'no_such_module', at `import no_such_module`",
    "x = (\n": ":1: SyntaxError: '(' was never closed, at `x = (`",
    "known = {}\ndef found(name):\n    return known[name]\nfound('x')\n": ":3: KeyError: 'x', at `return known[name]`",
    "import json\njson.loads('{')\n": ":2: JSONDecodeError: Expecting property name",
    "from lw_torchrl.language.relations import RELATIONS\nRELATIONS['on a ring around'] = ()\n": (
        ":2: ValueError: a relation may not be named 'on a ring around'"
    ),
    "import lw_torchrl as lw\nlw.load_plans('raech')\n": ":2: FileNotFoundError: ",
    "try:\n    {}['x']\nexcept KeyError as error:\n    raise OSError('no x') from error\n": ":4: OSError: no x, at",
}


@pytest.mark.parametrize("text", IMPORTED)
def test_an_error_while_a_module_is_imported_says_where(tmp_path, monkeypatch, capsys, text):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "mine", raising=False)
    (tmp_path / "mine.py").write_text(text)
    said = fails(capsys, "tasks", "--import", "mine")
    assert said.startswith(f"lw-torchrl: error: mine.py{IMPORTED[text]}")
    assert said.endswith(f"; {TRACEBACK}=1 shows the traceback\n")
    assert said.count("\n") == 1


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("nowhere", "--import 'nowhere' names no module: No module named 'nowhere'\n"),
        ("mine.py", "'mine' is not a package; did you mean 'mine'?\n"),
        ("", "'' is no module's name, which is like my_module"),
        ("my-module", "'my-module' is no module's name"),
    ],
)
def test_a_module_that_is_not_there(tmp_path, monkeypatch, capsys, name, says):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "mine", raising=False)
    (tmp_path / "mine.py").touch()
    assert says in fails(capsys, "tasks", "--import", name)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (b"x\0", "--import 'mine' names no module: source code string cannot contain null bytes"),
        (b"import sys\nsys.exit(0)\n", "mine.py:2: SystemExit: 0, at `sys.exit(0)`; a module of yours must not end"),
    ],
)
def test_a_module_of_bytes_and_one_that_ends_the_program(tmp_path, monkeypatch, capsys, text, says):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "mine", raising=False)
    (tmp_path / "mine.py").write_bytes(text)
    assert f"error: {says}" in fails(capsys, "tasks", "--import", "mine")


EVALUATORS = """
import lw_torchrl as lw
class Needs(lw.QueryEvaluator):
    def __init__(self, plans, size):
        super().__init__(plans)
class Exits(lw.QueryEvaluator):
    def logits(self, observation, task_id):
        raise SystemExit(0)
"""


@pytest.mark.parametrize(
    ("named", "says"),
    [
        ("StateQueryEvaluator", "--evaluator: StateQueryEvaluator knows nothing before it is trained; give a file of"),
        ("lw_torchrl:StateQueryEvaluator", "StateQueryEvaluator knows nothing before it is trained"),
        ("mine:Needs", "--evaluator mine:Needs: the class is made of the plans alone, its other arguments need def"),
        ("mine:Exits", "mine.py:8: SystemExit: 0, at `raise SystemExit(0)`"),
    ],
)
def test_an_evaluator_that_cannot_be_asked(tmp_path, monkeypatch, capsys, named, says):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "mine", raising=False)
    (tmp_path / "mine.py").write_text(EVALUATORS)
    few = ("--tasks", "reach", "--episodes", 1, "--max-steps", 2)
    assert says in fails(capsys, "evaluate", "few-shot-mt50", *few, "--import", "mine", "--evaluator", named)


def test_plans_for_a_policy_without_plans(tmp_path, capsys):
    lw.save_actor(lw.DescriptorConditionedActor("reach", width=8), tmp_path / "dc.safetensors")
    said = fails(capsys, "evaluate", tmp_path / "dc.safetensors", "--plans", "MT10", "--episodes", 1)
    assert "--plans is for policies with plans, DescriptorConditionedActor has none" in said


POLICY = """
import torch
import lw_torchrl as lw

def policy(tensordict):
    return act(tensordict)

def act(tensordict):
    {}
"""


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("return torch.cat(tensordict['observation'])", "TypeError: cat(): argument 'tensors'"),
        ("return tensordict.nothing", "AttributeError: "),
        ("return {}['x']", "KeyError: 'x'"),
        ("return lw.PlanConditionedActor(None)", "TypeError: plans must map task names"),
        ("raise RuntimeError('max_steps must be odd')", "RuntimeError: max_steps must be odd"),
    ],
)
def test_an_error_in_a_policy_of_yours_says_where(tmp_path, monkeypatch, capsys, line, says):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "mine", raising=False)
    (tmp_path / "mine.py").write_text(POLICY.format(line))
    said = fails(capsys, "evaluate", "mine:policy", "--tasks", "reach", "--episodes", 1, "--max-steps", 2)
    assert f"error: mine.py:9: {says}" in said
    assert f"at `{line}`; " in said


def test_a_traceback_on_request(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "mine", raising=False)
    (tmp_path / "mine.py").write_text("1 / 0\n")
    monkeypatch.setenv(TRACEBACK, "1")
    with pytest.raises(ZeroDivisionError):
        main(["tasks", "--import", "mine"])
    (tmp_path / "mine_too.py").write_text("raise SystemExit\n")
    with pytest.raises(RuntimeError, match=r"mine_too\.py:1: SystemExit"):
        main(["tasks", "--import", "mine_too"])


def test_names_are_options_in_our_own_errors_alone():
    with pytest.raises(ValueError, match="batch_size") as found:
        lw.BehavioralCloningConfig(batch_size=0)
    assert is_ours(found.value)
    with pytest.raises(json.JSONDecodeError) as found:
        json.loads("batch_size")
    assert not is_ours(found.value)
    said = "got self.batch_size=3, 'max_steps' and /tmp/max_steps; set batch_size"
    assert in_its_words("train", COMMANDS["train"], said) == said.replace("set batch_size", "set --batch-size")


@pytest.mark.parametrize("extends", [True, False])
def test_an_installed_package_is_the_user_s_where_it_extends_ours(tmp_path, monkeypatch, extends):
    place = tmp_path / "site-packages"
    about = place / "installed_thing-1.dist-info"
    about.mkdir(parents=True)
    group = "lw_torchrl.policies" if extends else "others.things"
    (about / "entry_points.txt").write_text(f"[{group}]\nMine = installed_thing:Mine\n")
    (about / "METADATA").write_text("Name: installed-thing\nVersion: 1\n")
    (place / "installed_thing.py").write_text("1 / 0\n")
    monkeypatch.syspath_prepend(place)
    monkeypatch.setattr(faults, "_extending", faults._extending.__wrapped__)
    with pytest.raises(ZeroDivisionError) as found:
        importlib.import_module("installed_thing")
    found.value.__traceback__ = found.value.__traceback__.tb_next  # this test is no library
    said = in_users_module(found.value)
    assert said == (
        f"{place}/installed_thing.py:1: ZeroDivisionError: division by zero, at `1 / 0`" if extends else None
    )
