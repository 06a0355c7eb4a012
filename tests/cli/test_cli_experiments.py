"""``lw-torchrl reproduce``: runs one by one, then a summary, tables and a figure beside the published curves."""

import json
import shutil
from dataclasses import replace
from functools import partial
from types import MappingProxyType

import pytest
from commands import document, fails, run
from lw_torchrl.paper import recipes, runs
from lw_torchrl.paper.recipes import PRESETS, DataSetting, Member

import lw_torchrl as lw

TINY = """
from dataclasses import replace
from functools import partial
import lw_torchrl as lw
from lw_torchrl.paper import recipes, runs
from lw_torchrl.paper.recipes import PRESETS, DataSetting, Execution, Member

training = lw.BehavioralCloningConfig(steps=40, batch_size=180, checkpoint_every=5)
options = {"target": Execution("clean", (0.0,)), "members": (Member({"width": 16, "depth": 1}),), "training": training}
recipes.SETTINGS = {
    "few-shot": DataSetting("few-shot", "MT10", 2), "one-shot": DataSetting("one-shot", "MT10", 1, targets="MT10")
}
recipes.PRESETS = {"strong": {name: replace(PRESETS["strong"][name], **options) for name in recipes.SETTINGS}}
runs.evaluate = partial(lw.evaluate, max_steps=20)
runs.collect_demonstrations = partial(lw.collect_demonstrations, max_steps=100)
"""


@pytest.fixture
def tiny(monkeypatch):
    """Experiments of one demonstration and twenty steps."""
    small = replace(
        PRESETS["strong"]["few-shot"],
        members=(Member({"width": 16, "depth": 1}),),
        training=lw.BehavioralCloningConfig(steps=20, batch_size=20),
    )
    paper = replace(small, name="paper", passes=500, evaluations=3)
    presets = {"strong": {"few-shot": small}, "paper": {"few-shot": paper}}
    monkeypatch.setattr(recipes, "PRESETS", MappingProxyType(presets))
    monkeypatch.setattr(runs, "evaluate", partial(lw.evaluate, max_steps=60))
    monkeypatch.setattr(recipes, "SETTINGS", MappingProxyType({"few-shot": DataSetting("few-shot", "reach", 1)}))


def arguments(out, *more, methods=("pcbc", "dc"), seeds=(0, 1)):
    return ("reproduce", "few-shot", "--seeds", *seeds, "--methods", *methods, "--episodes", 1, "--out", out, *more)


def test_units_and_their_summary(capsys, tmp_path, tiny):
    listed = run(capsys, *arguments(tmp_path, "--list")).split()
    datasets = [f"demonstrations/reachx1-astray-seed{seed}" for seed in (0, 1)]
    assert listed == [
        *datasets,
        *(f"few-shot/strong/{method}/seed{seed}" for method in ("pcbc", "dc") for seed in (0, 1)),
    ]
    assert not any(tmp_path.iterdir())

    run(capsys, *arguments(tmp_path, "--run", listed[1]))
    assert (tmp_path / listed[1] / "metadata.json").is_file()
    assert not (tmp_path / listed[0]).exists()
    out = run(capsys, *arguments(tmp_path, "--run", listed[-1]))
    assert "few-shot/strong/dc/seed1: mean success 0." in out
    assert not (tmp_path / "few-shot" / "strong" / "pcbc").exists()
    first = (tmp_path / listed[-1] / "results.json").read_text()

    out = run(capsys, *arguments(tmp_path))
    assert "[4/4] few-shot/strong/dc/seed1" in out
    assert "about 0 min left" in out
    assert "| PCBC published, last" in out
    assert "pcbc - dc: " in out
    assert "probability of improvement 0." in out
    folder = tmp_path / "few-shot" / "strong"
    summary = json.loads((folder / "summary.json").read_text())
    assert document(capsys, *arguments(tmp_path)) == {"summaries": {"few-shot/strong": summary}}
    one = document(capsys, *arguments(tmp_path, "--run", listed[-1]))
    assert [*one] == ["run", "tasks", "mean_success", "config"]
    assert (one["run"], len(one["tasks"])) == (listed[-1], 50)
    assert list(summary["methods"]) == ["pcbc", "dc"]
    assert list(summary["methods"]["dc"]["tasks"]) == list(lw.MT50)
    assert summary["pairs"][0]["methods"] == ["pcbc", "dc"]
    assert summary["published_means"]["PCBC published, last"] == pytest.approx(0.393, abs=1e-3)
    assert (folder / "summary.md").read_text().count("\n| ") == 4 + 2 + 52 + 2 - 1
    assert (folder / "tasks.png").read_bytes().startswith(b"\x89PNG")
    assert (folder / "dc" / "seed1" / "results.json").read_text() == first


@pytest.mark.slow
def test_the_best_of_several_evaluations_stands_beside_the_published(capsys, tmp_path, tiny):
    out = run(capsys, *arguments(tmp_path, "--preset", "paper", "--passes", 50, methods=["dc"]))
    assert "| dc, best of the last 3 evaluations " in out
    folder = tmp_path / "few-shot" / "paper"
    means = json.loads((folder / "summary.json").read_text())["published_means"]
    best = [json.loads((folder / f"dc/seed{seed}/results.json").read_text())["config"]["best"] for seed in (0, 1)]
    expected = sum(sum(one["rates"].values()) for one in best) / 100
    assert means["dc, best of the last 3 evaluations"] == pytest.approx(expected)
    assert list(means)[1:] == list(lw.evaluation.published_curves("few-shot", ("PCBC", "DC")))
    assert "dc, best of the last 3 evaluations" in (folder / "summary.md").read_text()


@pytest.mark.slow
def test_plans_of_ones_own(capsys, tmp_path, tiny):
    pairs = {task: [["the gripper is open", "move the gripper to the target"]] for task in lw.MT50}
    (tmp_path / "mine.json").write_text(json.dumps(pairs))
    own = ("--plans", tmp_path / "mine.json")
    out = run(capsys, "reproduce", "few-shot", "--seeds", 0, "--list", "--out", tmp_path, *own).split()
    assert out[1:] == [f"few-shot/strong-mine/{method}/seed0" for method in ("pcbc", "dc", "one-hot")]
    kept = tmp_path / "runs/compare/best/llama3.1/chain_py"  # as `plan compare` leaves them
    kept.mkdir(parents=True)
    (kept / "push.plan").write_text(str(lw.load_plans("MT10")["push"]))
    (name,) = run(capsys, *arguments(tmp_path, "--plans", "MT50", kept, "--list", methods=["pcbc"], seeds=[0])).split()[
        1:
    ]
    assert name == "few-shot/strong-MT50+llama3.1-chain_py/pcbc/seed0"
    run(capsys, *arguments(tmp_path / "out", "--run", out[1], *own, methods=["pcbc"], seeds=[0]))
    actor = lw.load_actor(tmp_path / "out" / out[1] / "policy.zip")
    assert actor.skills == ("move the gripper to the target",)


def test_what_it_refuses(capsys, tmp_path, tiny):
    message = fails(capsys, *arguments(tmp_path, "--run", "few-shot/strong/pbc/seed0"))
    assert "run must be one of" in message
    assert "did you mean 'few-shot/strong/pcbc/seed0'" in message
    assert "--passes is for --preset paper" in fails(capsys, *arguments(tmp_path, "--passes", 3))
    assert "passes must be at least 1" in fails(capsys, *arguments(tmp_path, "--preset", "paper", "--passes", 0))
    assert "--list names the runs" in fails(capsys, *arguments(tmp_path, "--list", "--run", "nope"))
    assert "jobs must be at least 1" in fails(capsys, *arguments(tmp_path, "--jobs", 0))


@pytest.mark.parametrize("chosen", [(), ("--run", 1), ("--run", 0), ("--list",)])
def test_plans_of_some_tasks_are_refused_before_any_work(capsys, tmp_path, tiny, chosen):
    (tmp_path / "push.plan").write_text(str(lw.load_plans("MT10")["push"]))
    own, out = ("--plans", tmp_path / "push.plan"), tmp_path / "out"
    names = run(capsys, *arguments(out, "--list")).replace("/strong/", "/strong-push/").split()
    message = fails(capsys, *arguments(out, *own, *(names[2 * arg] if arg in (0, 1) else arg for arg in chosen)))
    assert "--plans must have a plan for each of the 50 tasks, they lack 49: assembly, basketball, " in message
    assert f"--plans MT50 {tmp_path / 'push.plan'} takes ours" in message
    assert not out.exists()


def results(folder):
    """Every results file but for the times."""
    found = {}
    for path in folder.rglob("results.json"):
        result = json.loads(path.read_text())
        del result["config"]["seconds"], result["origin"]["date"]
        found[path.relative_to(folder).as_posix()] = result
    found = dict(sorted(found.items()))
    return found, json.loads(next(folder.rglob("summary.json")).read_text())


@pytest.mark.slow
@pytest.mark.parametrize("setting", ["few-shot", "one-shot"])
def test_killed_at_five_random_moments_it_ends_the_same(forks, tmp_path, setting):
    def command(out):
        return "reproduce", setting, "--methods", "pcbc", "--seeds", 0, "--episodes", 1, "--out", out

    whole, killed = forks.whole_and_killed(command, tmp_path, TINY)
    assert results(killed) == results(whole)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::FutureWarning", "ignore::DeprecationWarning")
def test_every_launcher_gives_the_same(capsys, tmp_path):
    found = {}
    for launcher, jobs in (("local", 1), ("local", 2), ("ray", 1)):
        out = tmp_path / f"{launcher}{jobs}"
        if launcher == "ray":  # one run there says it all; the other is done already
            shutil.copytree(tmp_path / "local2" / "scripted" / "seed1", out / "scripted" / "seed1")
        more = ("--seeds", 0, 1, "--episodes", 1, "--launcher", launcher, "--jobs", jobs, "--out", out)
        printed = run(capsys, "reproduce", "scripted", *more)
        assert "[2/2] scripted/seed" in printed
        assert "| scripted | 0." in printed or "| scripted | 1." in printed
        found[launcher, jobs] = results(out)
    assert found["local", 1] == found["local", 2] == found["ray", 1]
    assert list(found["ray", 1][0]) == ["scripted/seed0/results.json", "scripted/seed1/results.json"]
    assert (out / "scripted" / "tasks.png").is_file()
