"""``lw-torchrl info`` without arguments: the installation and the machine."""

import json

from commands import run

import lw_torchrl
from lw_torchrl.cli import machine


def test_info_reports_versions_extras_folders_and_slow_parts(capsys):
    printed = run(capsys, "info")
    titles = ("versions", "machine", "extras", "cache folders", "variables", "slow here")
    assert [line[:-1] for line in printed.splitlines() if line.endswith(":") and line[0] != " "] == [*titles]
    assert lw_torchrl.__version__ in printed
    document = json.loads(run(capsys, "info", "--json"))
    assert [*document] == ["versions", "machine", "extras", "cache_folders", "variables", "slow"]
    assert document["versions"]["torch"].startswith("2.")
    assert {"fast", "text", "ray"} <= {*document["extras"]}


def test_missing_packages_of_an_extra_are_named(monkeypatch):
    lines = ['numba>=0.61; extra == "fast"', 'not-a-package; extra == "odd"']
    monkeypatch.setattr(machine, "requires", lambda _: lines)
    assert machine.find_extras() == {"fast": [], "odd": ["not-a-package"]}


def test_slow_parts_are_explained(monkeypatch):
    monkeypatch.setattr(machine, "find_kernel", lambda: None)
    monkeypatch.setattr(machine, "available_cores", lambda: 1)
    monkeypatch.setattr(machine.os, "getloadavg", lambda: (50.0, 0.0, 0.0))
    reasons = " ".join(machine.find_slow_parts())
    assert all(text in reasons for text in ("NUMBA_CACHE_DIR", "only one core", "the load is 50.0"))
