"""``lw-torchrl offline``: runs one by one, tables, and that a killed command carries on to the same results."""

import json
import shutil

import pytest
from commands import document, fails, run
from lw_torchrl.paper import offline
from lw_torchrl.paper.recipes import OFFLINE_TABLES

import lw_torchrl as lw

SMALL = dict(width=16, depth=1, critic_depth=1, batch_size=20)
TINY = f"""
from dataclasses import replace
from lw_torchrl.paper import offline
runs = offline.offline_runs
offline.offline_runs = lambda table, seeds, recipe, n: runs(table, seeds, replace(recipe, **{SMALL}), n, 120)
"""


@pytest.fixture
def tiny(monkeypatch):
    """Episodes of 120 steps and small networks."""
    monkeypatch.setattr(offline, "offline_runs", offline.offline_runs)  # to be put back
    exec(TINY, {})


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """The data of seed 0, which runs share."""
    out = tmp_path_factory.mktemp("offline")
    for dataset in offline.OfflineRun("two", "W", 0, max_steps=120).datasets:
        dataset.collect(out, progress=False)
    return out / "data"


@pytest.fixture
def filled(data, tmp_path):
    """A folder with these data."""
    shutil.copytree(data, tmp_path / "data")
    return tmp_path


def arguments(out, *more):
    return "offline", "quick", "--steps", 5, "--episodes", 1, "--seeds", 0, "--out", out, *more


def results(folder):
    """Every results file but for the times, and the table."""
    found = {}
    for path in folder.rglob("results.json"):
        result = json.loads(path.read_text())
        del result["config"]["seconds"], result["origin"]["date"]
        found[path.relative_to(folder).as_posix()] = result
    return (
        dict(sorted(found.items())),
        (folder / "quick.md").read_text(),
        json.loads((folder / "quick.json").read_text()),
    )


def test_a_table_is_made_and_shown(capsys, filled, tiny):
    tmp_path = filled
    printed = run(capsys, *arguments(tmp_path))
    assert "[1/2] two/W/advantage-plan/seed0: mean success " in printed
    assert "| method, conditioned on | W " in printed
    assert f"quick.md, quick.json and quick.png are in {tmp_path}" in printed
    assert {path.name for path in tmp_path.glob("quick.*")} == {"quick.md", "quick.json", "quick.png"}
    found = document(capsys, *arguments(tmp_path))
    assert found == {"summaries": {"quick": json.loads((tmp_path / "quick.json").read_text())}}
    again = run(capsys, *arguments(tmp_path))
    assert again.split("\nquick\n")[1] == printed.split("\nquick\n")[1]


@pytest.mark.slow
def test_runs_have_names_and_are_done_one_by_one(capsys, data, tmp_path, tiny):
    names = run(capsys, *arguments(tmp_path, "--list")).split()
    assert names == [
        "data/two/spoilt-30-x20-seed0",
        "data/two/wrong-x20-seed0",
        "data/two/random-x10-seed0",
        "two/W/advantages/plan/seed0",
        "two/W/advantage-plan/seed0",
        "two/W/filtered-bc-plan/seed0",
    ]
    assert not list(tmp_path.iterdir())
    shutil.copytree(data, tmp_path / "data")
    for name in names:
        assert document(capsys, *arguments(tmp_path, "--run", name))["run"] == name
        assert (tmp_path / name).is_dir()
    assert not (tmp_path / "quick.md").exists()
    assert (tmp_path / "two/W/advantages/plan/seed0/advantages.zip").is_file()
    assert "[2/2] two/W/filtered-bc-plan/seed0" in run(capsys, *arguments(tmp_path))


def test_every_row_of_every_table_is_listed(capsys, tmp_path):
    listed = run(capsys, "offline", "all", "--list", "--out", tmp_path).split()
    assert len(set(listed)) == len(listed)
    for name, table in OFFLINE_TABLES.items():
        if name != "quick":
            for mixture in table.rows:
                assert f"{table.tasks}/{mixture}/advantage-plan/seed2" in listed
    assert not any("two/" in name for name in listed)
    some = run(
        capsys, "offline", "methods", "--list", "--mixtures", "C", "--methods", "bc", "best-bc", "--out", tmp_path
    )
    assert [name for name in some.split() if not name.startswith("data/")] == [
        f"five/C/{method}-plan/seed{seed}" for method in ("best-bc", "bc") for seed in (0, 1, 2)
    ]


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (("--run", "two/W/advantag-plan/seed0"), "did you mean 'two/W/advantage-plan/seed0'"),
        (("--mixtures", "D"), "mixtures must be one of 'B', 'W', 'C', got 'D'"),
        (("--methods", "awr"), "methods must be one of 'advantage'"),
        (("--mixtures", "B"), "--mixtures and --methods leave nothing of quick"),
        (("--seeds", 100), "seed must be from 0 to 99, got 100"),
        (("--jobs", 0), "jobs must be at least 1"),
        (("--list", "--run", "x"), "--list names the runs and does none"),
        (("--beta", -1), "beta must be finite and at least 0"),
    ],
)
def test_what_it_refuses(capsys, tmp_path, more, message):
    assert message in fails(capsys, *arguments(tmp_path / "out", *more))
    assert not (tmp_path / "out").exists()


def test_plans_that_lack_a_task_are_refused_before_any_work(capsys, tmp_path):
    (tmp_path / "push.plan").write_text(str(lw.load_plans("MT10")["push"]))
    message = fails(capsys, *arguments(tmp_path / "out", "--plans", tmp_path / "push.plan"))
    assert "plans lack door-open, drawer-open" in message
    assert not (tmp_path / "out").exists()


def test_another_recipe_in_the_same_folder_is_refused(capsys, filled, tiny):
    run(capsys, *arguments(filled, "--methods", "filtered-bc"))
    assert "is of another configuration, it differs in recipe.beta" in fails(
        capsys, *arguments(filled, "--methods", "filtered-bc", "--beta", 3)
    )


@pytest.mark.slow
def test_two_processes_give_what_one_gives(capsys, forks, tmp_path):
    alone = "--methods", "advantage"
    run(capsys, *arguments(tmp_path / "1", *alone))
    for kind in ("spoilt-30-x20", "random-x10"):  # one dataset made there says it all
        shutil.copytree(tmp_path / f"1/data/two/{kind}-seed0", tmp_path / f"2/data/two/{kind}-seed0")
    run(capsys, *arguments(tmp_path / "2", *alone, "--jobs", 2))
    assert results(tmp_path / "1") == results(tmp_path / "2")


@pytest.mark.slow
def test_killed_at_five_random_moments_it_ends_the_same(forks, tmp_path):
    def command(out):
        return "offline", "quick", "--steps", 500, "--episodes", 1, "--seeds", 0, "--out", out

    whole, killed = forks.whole_and_killed(command, tmp_path, TINY)
    assert results(killed) == results(whole)
