"""``lw-torchrl data show`` and who acts in ``lw-torchrl collect``."""

from __future__ import annotations

import json
import re
import shutil
import statistics
import time

import pytest
import torch
from commands import fails, run

import lw_torchrl as lw
import lw_torchrl.data as data_room
import lw_torchrl.data.memory_map as memory_map
from lw_torchrl import _progress
from lw_torchrl.cli.main import main
from lw_torchrl.data import collect_demonstrations
from lw_torchrl.data.memory_map import load_rows


def collect(root, **options):
    return collect_demonstrations(
        **{"tasks": ["push", "reach"], "episodes_per_task": 3, "max_steps": 34, "progress": False, **options}, root=root
    )


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    root = tmp_path_factory.mktemp("shown")
    return [
        collect(root / "good", noise_scale=(0.0, 0.3), noise_hold=7, redraw_failures=False),
        collect(root / "spoilt", policy="spoilt-30", seed=5),
        collect(root / "random", tasks="reach", policy="random"),
    ]


def lines_of(printed):
    """Name to the numbers of each line of the tables."""
    pattern = re.compile(
        r"^(\S+) +(\d+) +(\d+) +(\d\.\d\d) +(never|\d+ \(\d+\.\.\d+\)) +(-?[\d.]+) +(-?[\d.]+) (-?[\d.]+) (-?[\d.]+)$",
        re.MULTILINE,
    )
    return {found[0]: found[1:] for found in pattern.findall(printed)}


def by_hand(episodes):
    """What a line says of (description, rows of its dataset)."""
    earned = []
    for info, rows in episodes:
        dense = rows["next", "reward_dense"][info.start : info.start + info.length].flatten().tolist()
        earned.append(sum(dense))
    first = sorted(info.first_success for info, _ in episodes if info.success)
    when = f"{statistics.median(first):.0f} ({first[0]}..{first[-1]})" if first else "never"
    ordered = sorted(earned)

    def at(share):
        place = share * (len(ordered) - 1)
        low = int(place)
        return ordered[low] + (place - low) * (ordered[min(low + 1, len(ordered) - 1)] - ordered[low])

    numbers = [sum(earned) / len(earned), at(0.25), at(0.5), at(0.75)]
    return (
        str(len(episodes)),
        str(sum(info.length for info, _ in episodes)),
        f"{len(first) / len(episodes):.2f}",
        when,
        *numbers,
    )


def same(line, expected):
    assert line[:4] == expected[:4]
    assert [float(number) for number in line[4:]] == pytest.approx(expected[4:], abs=0.051)


def test_the_lines_of_a_mixture_are_those_by_hand(capsys, made):
    printed = run(capsys, "data", "show", *[one.root for one in made])
    found = lines_of(printed)
    assert list(found) == ["push", "reach", "noisy", "random", "spoilt-30", "all"]
    every = [(one.config.behaviour, info, load_rows(one)) for one in made for info in one.episodes]
    same(found["all"], by_hand([pair for _, *pair in every]))
    for task in ("push", "reach"):
        same(found[task], by_hand([(info, rows) for _, info, rows in every if info.task == task]))
    for label in ("noisy", "random", "spoilt-30"):
        same(found[label], by_hand([(info, rows) for of, info, rows in every if of == label]))
    assert found["random"][2:4] == ("0.00", "never")
    assert all(len(line) <= 120 for line in printed.splitlines())


def test_it_says_how_a_dataset_was_made(capsys, made):
    good, spoilt, random = (run(capsys, "data", "show", one.root) for one in made)
    size = sum(path.stat().st_size for path in made[0].root.rglob("*") if path.is_file())
    assert f"dataset    {made[0].root}: {size / 1000:.3g} kB, format version 2" in " ".join(good.split("\n           "))
    assert "behaviour  noisy: Meta-World's scripts" in good
    assert "tasks      push, reach" in good
    assert "episodes   3 of each task, of at most 34 steps, seed 0\n" in good
    assert "noise      0, 0.3; held for 7 steps, on the gripper x0.2" in good
    assert f"lw_torchrl {lw.__version__}" in good
    assert "torchrl" in good
    fingerprint = made[1].config.policy.fingerprint[:16]
    said = f"plans (fingerprint {fingerprint}) with scripted skills in 0.3 of pieces of 8 to 24 steps, else any"
    assert said in " ".join(spoilt.split())
    assert "noise      none" in spoilt
    assert "seed 5" in spoilt
    assert "behaviour  random: one action for 8 to 24 steps, after another" in random
    assert list(lines_of(random)) == ["reach", "all"]


def test_failures_that_were_drawn_again_are_counted(capsys, tmp_path):
    options = dict(tasks="reach", policy="wrong", episodes_per_task=2, seed=5, max_steps=31, redraw_failures=True)
    made = collect(tmp_path / "demos", **options)
    again = made.attempts["reach"] - 2
    assert again > 0, "the test wants failures"
    said = f"seed 5; {again} failure{'s' * (again != 1)} drawn again"
    assert said in run(capsys, "data", "show", made.root)


def test_check_reads_every_row(capsys, made, tmp_path):
    printed = run(capsys, "data", "show", made[0].root, made[1].root, "--check")
    assert printed.endswith("\nchecked: all rows of 2 datasets are as they were written\n")
    root = shutil.copytree(made[1].root, tmp_path / "demos")
    path = root / "data" / "action.memmap"
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    run(capsys, "data", "show", root)
    with pytest.raises(SystemExit) as caught:
        run(capsys, "data", "show", root, "--check")
    assert caught.value.code == 2
    error = capsys.readouterr().err
    assert "is damaged: 1 of 6 episodes differ from their checksums; delete the folder" in error


def test_a_long_check_writes_lines_into_a_pipe(capsys, made, monkeypatch):
    describe = memory_map.describe_episode
    monkeypatch.setattr(memory_map, "describe_episode", lambda *given: time.sleep(0.4) or describe(*given))
    monkeypatch.setattr(_progress, "EVERY", 0.5)
    main(["data", "show", str(made[0].root), "--check"])
    error = capsys.readouterr().err
    assert "\r" not in error
    assert re.fullmatch(r"(checking: \d/6 episodes, \d s left\n)+", error)


def test_what_is_no_dataset_is_one_line(capsys, made, tmp_path):
    assert "FOLDERS: no dataset folder" in (error := fails(capsys, "data", "show", tmp_path / "nowhere"))
    assert "make one with `lw-torchrl collect`" in error
    assert "FOLDERS must name at least one dataset" in fails(capsys, "data", "show")
    root = shutil.copytree(made[0].root, tmp_path / "demos")
    (root / "metadata.json").write_text("{")
    assert "damaged" in fails(capsys, "data", "show", made[1].root, root)
    other = shutil.copytree(made[1].root, tmp_path / "other")
    stated = json.loads((other / "metadata.json").read_text())
    stated["config"]["policy"].update(name="twice", fingerprint=None)
    (other / "metadata.json").write_text(json.dumps(stated))
    third = shutil.copytree(other, tmp_path / "third")
    stated["config"]["policy"].update(right=0.4)
    (third / "metadata.json").write_text(json.dumps(stated))
    assert "'twice' names different behaviours" in fails(capsys, "data", "show", other, third)


# ---- collect


@pytest.fixture
def asked(monkeypatch):
    """What `lw-torchrl collect` asks for, with short episodes."""
    seen = []

    def short(tasks, **options):
        seen.append(options)
        return collect_demonstrations(tasks, **options, max_steps=5, progress=False)

    monkeypatch.setattr(data_room, "collect_demonstrations", short)
    return seen


def test_collect_by_a_behaviour_of_a_name(capsys, tmp_path, asked):
    args = ("collect", "reach", "--out", tmp_path / "demos", "--episodes", 2, "--policy", "spoilt-30")
    run(capsys, *args, "--behaviour", "mine", "--gripper-noise", 1, "--noise", 0.1)
    found = lw.LanguageWorldExperienceReplay(tmp_path / "demos", label="executed").demonstrations
    assert (found.config.policy.name, found.config.policy.right) == ("mine", 0.3)
    assert found.config.gripper_noise_factor == 1.0
    error = fails(capsys, *args, "--behaviour", "other", "--gripper-noise", 1, "--noise", 0.1)
    assert "policy.name ('mine', now 'other')" in error


def test_collect_by_a_policys_file(capsys, tmp_path, asked):
    torch.manual_seed(0)
    lw.save_actor(lw.PlanConditionedActor(lw.load_plans("MT10"), width=8), tmp_path / "tiny one.safetensors")
    args = ("collect", "reach", "--episodes", 2, "--policy", tmp_path / "tiny one.safetensors", "--out")
    run(capsys, *args, tmp_path / "a")
    run(capsys, *args, tmp_path / "b", "--behaviour", "mine")
    labels = [lw.LanguageWorldExperienceReplay(tmp_path / one, label="executed").behaviours for one in "ab"]
    assert labels == [("tiny one",), ("mine",)]
    shown = run(capsys, "data", "show", tmp_path / "a")
    assert re.search(r"tiny one: a policy, fingerprint [0-9a-f]{16}\n", shown)
    assert "assembly" in fails(capsys, "collect", "assembly", *args[2:], tmp_path / "c")


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        ("raondm", "--policy must be one of 'expert', 'scripted'"),
        ("nowhere.safetensors", "--policy: no file 'nowhere.safetensors'"),
        (".", "--policy: '.' is a folder; a policy is one file"),
    ],
)
def test_who_cannot_act_is_refused_before_anything_is_made(capsys, tmp_path, monkeypatch, policy, message):
    monkeypatch.chdir(tmp_path)
    assert message in fails(capsys, "collect", "reach", "--out", "demos", "--policy", policy)
    assert not (tmp_path / "demos").exists()
