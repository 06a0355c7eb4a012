"""``lw-torchrl online``: weak starts, what methods make of them, a summary beside a figure; stopped, it carries on."""

import json
from functools import partial

import pytest
from commands import document, fails, run
from lw_torchrl.paper import online, runs

import lw_torchrl as lw

TINY = """
from functools import partial
import lw_torchrl as lw
from lw_torchrl.paper import online, runs
from lw_torchrl.training import algorithms

cloning = lw.BehavioralCloningConfig(steps=30, batch_size=20, checkpoint_every=10)
config = lw.OnlineConfig(rows=4, round_steps=15, max_steps=12, batch_size=8)
online.OnlineRecipe = partial(online.OnlineRecipe, cloning=cloning, config=config)
def method_config(method, given):
    found, few = algorithms.method_config(method, given), dict(first_frames=20, warm_up=3, epochs=2)
    return online.replace(found, **{name: number for name, number in few.items() if hasattr(found, name)})
online.method_config = method_config
online.evaluate = runs.evaluate = partial(lw.evaluate, max_steps=20)
runs.collect_demonstrations = partial(lw.collect_demonstrations, max_steps=100)
"""


@pytest.fixture
def tiny(monkeypatch):
    """Few steps of everything."""
    for module, name in (
        (online, "OnlineRecipe"),
        (online, "method_config"),
        (online, "evaluate"),
        (runs, "evaluate"),
        (runs, "collect_demonstrations"),
    ):
        monkeypatch.setattr(module, name, getattr(module, name))  # to be put back
    exec(TINY, {})


def arguments(out, *more, methods=("td3", "expert-iteration"), seeds=(0,)):
    given = ("--methods", *methods, "--seeds", *seeds, "--frames", 180, "--episodes", 2, "--out", out)
    return ("online", "reach", *given, *more)


def test_runs_and_their_summary(capsys, tmp_path, tiny, monkeypatch):
    listed = run(capsys, *arguments(tmp_path, "--list", seeds=(0, 1))).split()
    starts = [f"pcbc/reach/start/seed{seed}" for seed in (0, 1)]
    methods = [f"pcbc/reach/{method}/seed{seed}" for seed in (0, 1) for method in ("td3", "expert-iteration")]
    assert listed == [*starts, *methods]
    assert not any(tmp_path.iterdir())

    out = run(capsys, *arguments(tmp_path, "--run", "pcbc/reach/td3/seed1", "--logger", "csv", seeds=(0, 1)))
    assert "pcbc/reach/td3/seed1: mean success 0." in out
    folder = tmp_path / "pcbc" / "reach"
    assert (folder / "start" / "seed1" / "policy.zip").is_file()
    assert not (folder / "start" / "seed1" / "results.json").exists(), "the start is evaluated by its own run"
    assert (folder / "td3" / "seed1" / "logs" / "policy" / "scalars" / "train" / "success.csv").is_file()
    assert sorted(path.name for path in (folder / "td3" / "seed1").iterdir()) == ["logs", "policy.zip", "results.json"]
    first = (folder / "td3" / "seed1" / "results.json").read_text()
    config = json.loads(first)["config"]
    assert (config["seed"], config["noise_scale"], config["tasks"]) == (10_001, 0.1, ["reach"])
    assert [one["frames"] for one in config["history"]] == [60, 120, 180]
    assert config["run"]["recipe"]["config"]["frames"] == 180
    assert config["run"]["plans"] == lw.Plans([lw.load_plans("MT50")["reach"]]).fingerprint

    out = run(capsys, *arguments(tmp_path, seeds=(0, 1)))
    assert "[6/6] pcbc/reach/expert-iteration/seed1" in out
    assert "| reach | 0." in out
    assert "td3 - expert-iteration: " in out
    assert "td3 - start: " in out
    assert (folder / "td3" / "seed1" / "results.json").read_text() == first
    summary = json.loads((tmp_path / "pcbc" / "summary.json").read_text())
    assert list(summary["methods"]) == ["td3", "expert-iteration", "start"]
    assert [step for step, _ in summary["curves"]["reach"]["td3"][1]] == [60, 120, 180]
    assert (tmp_path / "pcbc" / "curves.png").read_bytes().startswith(b"\x89PNG")
    assert "| reach | 0." in (tmp_path / "pcbc" / "summary.md").read_text()

    monkeypatch.setattr(runs, "evaluate", lambda *_, **__: pytest.fail("done twice"))
    found = document(capsys, *arguments(tmp_path, seeds=(0, 1)))
    assert found == {"summaries": {"pcbc": json.loads((tmp_path / "pcbc" / "summary.json").read_text())}}
    message = fails(capsys, *arguments(tmp_path, "--demonstrations", 2))
    assert "is of another configuration, it differs in recipe.demonstrations (1, now 2); choose another" in message


SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("sac", "ppo")]


@pytest.mark.parametrize("method", ["residual", *SLOW])
def test_any_method_begins_with_a_policy_of_ones_own(capsys, tmp_path, tiny, method):
    lw.save_actor(lw.DescriptorConditionedActor("MT10", width=16), tmp_path / "mine.zip")
    out, given = tmp_path / "out", ("--start", tmp_path / "mine.zip")
    printed = run(capsys, *arguments(out, *given, methods=[method]))
    assert f"from-mine/reach/{method}/seed0" in printed
    config = json.loads((out / "from-mine" / "reach" / method / "seed0" / "results.json").read_text())["config"]
    assert len(config["run"]["start"]) == 64
    assert "condition" not in config["run"]
    kept = lw.load_actor(out / "from-mine" / "reach" / method / "seed0" / "policy.zip")
    assert kept.tasks == lw.MT10
    lw.save_actor(lw.DescriptorConditionedActor("MT10", width=16), tmp_path / "mine.zip")  # of other weights
    assert "is of another configuration, it differs in start" in fails(
        capsys, *arguments(out, *given, methods=[method])
    )


@pytest.mark.slow
def test_a_start_may_be_conditioned_otherwise(capsys, tmp_path, tiny):
    assert "one-hot/reach/td3/seed0: " in run(capsys, *arguments(tmp_path, "--condition", "one-hot", methods=["td3"]))
    policy = lw.load_actor(tmp_path / "one-hot" / "reach" / "td3" / "seed0" / "policy.zip")
    assert policy.config["condition"] == "one-hot"


def test_what_it_refuses(capsys, tmp_path, tiny):
    message = fails(capsys, *arguments(tmp_path, "--run", "pcbc/reach/tb3/seed0"))
    assert "--run must be one of" in message
    assert "did you mean 'pcbc/reach/td3/seed0'" in message
    assert "--list names the runs" in fails(capsys, *arguments(tmp_path, "--list", "--run", "nope"))
    assert "--jobs must be at least 1" in fails(capsys, *arguments(tmp_path, "--jobs", 0))
    assert "--demonstrations must be at least 1" in fails(capsys, *arguments(tmp_path, "--demonstrations", 0))
    assert "--frames must be a multiple of rows, 4, got 181" in fails(capsys, *arguments(tmp_path, "--frames", 181))
    assert "--start: no file " in fails(capsys, *arguments(tmp_path, "--start", tmp_path / "nope.zip"))
    assert "TASKS must be" in fails(capsys, "online", "raech", "--out", tmp_path)
    for given in (("--frames", 200), ("--logger", "csv")):
        message = fails(capsys, "online", "reach", "--methods", "start", *given, "--out", tmp_path)
        assert f"{given[0]} is of the methods advantage, td3, sac, residual, ppo, expert-iteration, " in message
        assert "--methods are start" in message
    (tmp_path / "push.plan").write_text(str(lw.load_plans("MT10")["push"]))
    message = fails(capsys, *arguments(tmp_path, "--plans", tmp_path / "push.plan"))
    assert "plans lack reach; they cover push" in message
    lw.save_actor(lw.DescriptorConditionedActor("push", width=16), tmp_path / "push.zip")
    message = fails(capsys, *arguments(tmp_path, "--start", tmp_path / "push.zip"))
    assert "does not know the task 'reach'" in message
    assert not (tmp_path / "pcbc").exists()


@pytest.mark.parametrize("step", [pytest.param("2", marks=pytest.mark.slow), "weakest"])
def test_one_step_of_a_plan_is_tuned(capsys, tmp_path, tiny, monkeypatch, step):
    given = arguments(tmp_path, "--step", step, methods=["residual"])
    name = "residual-step2" if step == "2" else "residual-weakest"
    assert run(capsys, *given, "--list").split() == ["pcbc/reach/start/seed0", f"pcbc/reach/{name}/seed0"]
    out = run(capsys, *given, "--run", f"pcbc/reach/{name}/seed0")
    config = json.loads((tmp_path / "pcbc" / "reach" / name / "seed0" / "results.json").read_text())["config"]
    tuned, elsewhere = config["tuned"], config["elsewhere"]
    chosen = lw.load_plans("MT50")["reach"].steps[tuned["step"]]
    assert (tuned["skill"], tuned["condition"]) == (chosen.skill, str(chosen.condition))
    if step == "2":
        assert tuned["step"] == 1
        assert "ended here" not in out
    else:
        most = max(tuned["stuck"], key=lambda one: one["furthest"])
        assert most["step"] == tuned["step"]
        assert [line.split()[:2] for line in out.splitlines()[1:5]] == [
            ["task", "step"],
            *(["reach", str(number)] for number in (1, 2, 3)),
        ]
    assert f"tuned: step {tuned['step'] + 1}, {chosen.skill}; success before {config['before']:.3f}" in out
    start = json.loads((tmp_path / "pcbc" / "reach" / "start" / "seed0" / "results.json").read_text())
    assert config["before"] == sum(one["success"] for one in start["episodes"]) / 2
    assert elsewhere["states"] == 2 * 20
    assert elsewhere["outside"] <= elsewhere["states"]
    assert elsewhere["changed"] == 0
    assert f"{elsewhere['outside']} of {elsewhere['states']} states are outside of it" in out
    policy = lw.load_actor(tmp_path / "pcbc" / "reach" / name / "seed0" / "policy.zip")
    assert policy.steps == {"reach": [tuned["step"]]}

    assert "residual - start: " in run(capsys, *given)
    monkeypatch.setattr(online, "tune_step", lambda *_, **__: pytest.fail("done twice"))
    assert out.splitlines()[-1] in run(capsys, *given)


def test_steps_that_it_refuses(capsys, tmp_path, tiny):
    for step in ("0", "-1", "first", "1.5", "²", "9" * 5000, ""):
        message = fails(capsys, *arguments(tmp_path, f"--step={step}", methods=["residual"]))
        assert "--step must be the number of a step, from 1, or weakest, got " in message
        assert len(message) < 300
    message = fails(capsys, *arguments(tmp_path, "--step", "1"))
    assert "--step is of the method residual, --methods are td3, expert-iteration" in message
    message = fails(capsys, *arguments(tmp_path, "--step", "9", methods=["residual"]))
    assert "--step: the plan of 'reach' has 3 steps, got 9" in message
    lw.save_actor(lw.DescriptorConditionedActor("MT10", width=16), tmp_path / "mine.zip")
    for step, part in (("1", "step1"), ("weakest", "weakest")):  # alone, since the start's run would print
        given = ("--start", tmp_path / "mine.zip", "--step", step, "--run", f"from-mine/reach/residual-{part}/seed0")
        message = fails(capsys, *arguments(tmp_path / "out", *given, methods=["residual"]))
        assert "DescriptorConditionedActor" in message
        assert "plans" in message


def results(folder):
    """Every results file but for the times."""
    found = {}
    for path in sorted(folder.rglob("results.json")):
        result = json.loads(path.read_text())
        del result["config"]["seconds"], result["origin"]["date"]
        found[path.relative_to(folder).as_posix()] = result
    return found, json.loads(next(folder.rglob("summary.json")).read_text())


@pytest.mark.slow
def test_killed_at_five_random_moments_it_ends_the_same(forks, tmp_path):
    whole, killed = forks.whole_and_killed(arguments, tmp_path, TINY)
    assert results(killed) == results(whole)


def test_a_run_killed_before_its_result_is_not_trained_again(tmp_path, tiny, monkeypatch):
    plans = lw.load_plans("MT50")
    recipe = online.OnlineRecipe()
    one = online.OnlineRun("reach", "td3", 0, recipe, episodes=2)
    one = online.replace(one, recipe=online.replace(recipe, config=online.replace(recipe.config, frames=60)))
    monkeypatch.setattr(runs, "evaluate", lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        runs.execute_run(one, plans, tmp_path, progress=False)
    monkeypatch.setattr(runs, "evaluate", partial(lw.evaluate, max_steps=20))
    monkeypatch.setattr(online, "OnlineTrainer", lambda *_, **__: pytest.fail("trained again"))
    found = runs.execute_run(one, plans, tmp_path, progress=False)
    assert [entry["frames"] for entry in found.config["history"]] == [60]
