"""The experiments' runs: resumed anywhere they end with the same result."""

import shutil
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
import torch
from lw_torchrl.paper import imitation, runs
from lw_torchrl.paper.imitation import SCRIPTED, ImitationRun
from lw_torchrl.paper.recipes import PRESETS, SETTINGS, Member
from lw_torchrl.paper.runs import load_result
from tiny_runs import (
    ENSEMBLE,
    FOCUS,
    MEMBER,
    OTHER,
    PLANS,
    PRESET,
    ROLES,
    TINY,
    TINY_ONE_SHOT,
    a_run,
    execute,
    execute_short,
    rates,
    stop_training,
    task_of,
)

import lw_torchrl as lw
from lw_torchrl.modules import METHODS
from lw_torchrl.training.files import demonstration_seeds


def backwards(texts):
    return lengths(texts).flip(-1)


def lengths(texts):
    return torch.tensor([[len(text), len(text.split()), text.count("e"), 1.0] for text in texts])


EVALUATOR = replace(
    PRESET,
    name="evaluator",
    members=(
        Member(
            {"features": "differences", "width": 32, "depth": 1},
            {"evaluator": {"kind": "StateQueryEvaluator", "options": {"width": 16, "depth": 1}}, "answers": "tanh"},
        ),
    ),
    training=replace(PRESET.training, qaf_anchor=1.0),
)
RUNS = [
    *(a_run(method) for method in (*METHODS, SCRIPTED)),
    *(a_run(method, setting=TINY_ONE_SHOT) for method in METHODS),
    *(
        a_run(method, setting=setting, preset=ENSEMBLE)
        for method in ("pcbc", "dc")
        for setting in (TINY, TINY_ONE_SHOT)
    ),
]
by_name = pytest.mark.parametrize("one", RUNS, ids=lambda one: f"{one.setting.name} {one.preset.name} {one.method}")


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    out = tmp_path_factory.mktemp("undisturbed")
    for one in RUNS:
        execute(one, out)
    return out


@by_name
def test_a_unit_leaves_its_result_and_is_not_done_twice(undisturbed, one, monkeypatch):
    episodes, config = rates(undisturbed / one.folder)
    assert [episode["task"] for episode in episodes] == [task_of(one)] * 2
    assert (config["seed"], config["noise_scale"], config["tasks"]) == (10_003, 0.1, [task_of(one)])
    monkeypatch.setattr(runs, "evaluate", lambda *_, **__: pytest.fail("evaluated again"))
    assert len(execute(one, undisturbed).episodes) == 2


def test_folders(undisturbed):
    assert a_run().folder.as_posix() == "tiny/strong/pcbc/seed3"
    assert a_run("scripted").folder.as_posix() == "scripted/seed3"
    assert a_run("scripted", setting=TINY_ONE_SHOT).folder == a_run("scripted").folder
    named = replace(a_run(), plans_name="palm")
    assert named.folder.as_posix() == "tiny/strong-palm/pcbc/seed3"
    found = {path.name for path in (undisturbed / "demonstrations").iterdir() if path.name[0] != "."}
    assert found == {"reachx2-astray-seed3", "pushx1-target-seed3"}
    assert a_run(seed=4).datasets != a_run().datasets


@by_name
def test_the_result_says_what_was_done(undisturbed, one):
    said = rates(undisturbed / one.folder)[1]["run"]
    assert (said["method"], said["seed"]) == (one.method, 3)
    assert (said["plans"] is None) == (one.method in ("dc", "one-hot"))
    if one.method == "scripted":
        assert said.keys() == {"method", "seed", "plans"}
    else:
        first, *more = said["members"]
        focus = FOCUS if one.method == "pcbc" else {}
        assert first == {"actor": {"features": "differences", "width": 32, "depth": 1, **focus}, "yaw": 0.0}
        other = {"actor": {"features": "relative", "width": 16, "depth": 1}, "yaw": 0.3}
        if one.method == "pcbc":
            other = {"actor": {**other["actor"], **ROLES}, "yaw": 0.3, "any_yaw": True}
        assert more == ([other] if one.preset is ENSEMBLE else [])
        assert said["training"]["steps"] == 60
        assert said["datasets"][0]["execution"]["noise_scale"] == [0.0, 0.1, 0.2, 0.3, 0.4]
        assert len(said["datasets"]) == (2 if one.setting.targets else 1)
        assert said["after_success"] == 20


def test_a_result_of_another_configuration_is_refused(undisturbed):
    longer = replace(PRESET, training=replace(PRESET.training, steps=61))
    message = r"is of another configuration, it differs in training.steps \(60, now 61\); choose another folder"
    with pytest.raises(ValueError, match=message):
        execute(a_run("dc"), undisturbed, longer)
    with pytest.raises(ValueError, match="differs in plans;"):
        load_result(a_run(), lw.load_plans("MT50", skills="MT10"), undisturbed)
    with pytest.raises(ValueError, match=r"differs in episodes \(.*, now 3\)"):
        load_result(replace(a_run(), episodes=3), PLANS, undisturbed)


def test_a_result_of_other_tasks_is_refused(undisturbed):
    """It gave reach's result for push's."""
    for one in (a_run(), a_run(SCRIPTED)):
        with pytest.raises(
            ValueError, match=r"another configuration, it differs in tasks \(\['reach'\], now \['push'\]\)"
        ):
            execute_short(one, undisturbed, tasks="push")
    one = a_run(setting=TINY_ONE_SHOT)
    assert execute_short(one, undisturbed, tasks=["push", "reach"]).config["tasks"] == ["push"]
    with pytest.raises(ValueError, match="tasks must name some of the run's, push, got reach"):
        execute_short(one, undisturbed, tasks="reach")


def test_a_result_of_another_description_of_a_task_is_refused(undisturbed):
    """Plans' fingerprint does not tell what a task's description says, by which "dc" is conditioned."""
    reach = replace(lw.TASKS["reach"], description="Go there.")
    plans = lw.Plans({**PLANS, "reach": lw.ConditionalPlan("reach", PLANS["reach"].steps, reach)})
    assert plans.fingerprint == PLANS.fingerprint
    with pytest.raises(ValueError, match="another configuration, it differs in own_tasks"):
        execute_short(a_run("dc"), undisturbed, plans, tasks="reach")
    assert execute_short(a_run("pcbc"), undisturbed, plans, tasks="reach")


def test_what_a_result_says_beyond_the_run_counts(undisturbed, tmp_path):
    shutil.copytree(undisturbed / a_run().folder, tmp_path / a_run().folder)
    found = lw.EvaluationResult.load(tmp_path / a_run().folder / "results.json")
    found.config["run"]["evaluations"] = 10
    found.save(tmp_path / a_run().folder / "results.json")
    with pytest.raises(ValueError, match=r"it differs in evaluations \(10, now None\)"):
        execute(a_run(), tmp_path)


def test_a_run_waits_for_another_process_that_does_it(undisturbed, tmp_path, holding, capfd):
    """Its result is there afterwards, and it is not done twice."""
    one = a_run("dc")
    folder = tmp_path / one.folder
    release = holding(folder, folder=True)
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(execute, one, tmp_path)
        deadline = time.monotonic() + 20
        while f"waiting for another process that is at work in '{folder}'" not in capfd.readouterr().err:
            assert time.monotonic() < deadline
            time.sleep(0.05)
        shutil.copyfile(undisturbed / one.folder / "results.json", folder / "results.json")
        release()
        assert waiting.result() == lw.EvaluationResult.load(undisturbed / one.folder / "results.json")
    assert [path.name for path in folder.iterdir()] == ["results.json"]


@pytest.mark.parametrize(
    ("setting", "preset", "stop"),
    [
        pytest.param(TINY, PRESET, 46, marks=pytest.mark.slow),
        (TINY_ONE_SHOT, PRESET, 46),
        pytest.param(TINY, ENSEMBLE, 46, marks=pytest.mark.slow),
        (TINY, ENSEMBLE, 106),
        pytest.param(TINY_ONE_SHOT, ENSEMBLE, 46, marks=pytest.mark.slow),
        pytest.param(TINY_ONE_SHOT, ENSEMBLE, 106, marks=pytest.mark.slow),
    ],
)
def test_stopped_in_training_and_resumed_it_ends_the_same(undisturbed, tmp_path, monkeypatch, setting, preset, stop):
    one = a_run(setting=setting, preset=preset)
    count = stop_training(monkeypatch, setting, stop)
    with pytest.raises(KeyboardInterrupt):
        execute(one, tmp_path)
    execute(one, tmp_path)
    assert count[0] == 60 * len(preset.members) + 6  # it carried on from the checkpoint before, one every 20 steps
    assert rates(tmp_path / one.folder) == rates(undisturbed / one.folder)


def test_scripts_are_the_same_in_every_setting_and_run_once(undisturbed, monkeypatch):
    monkeypatch.setattr(runs, "evaluate", lambda *_, **__: pytest.fail("evaluated again"))
    other = a_run("scripted", setting=TINY_ONE_SHOT)
    assert load_result(other, PLANS, undisturbed) == load_result(a_run("scripted"), PLANS, undisturbed)


def test_the_policies_of_one_shot_are_kept_one_by_one(undisturbed):
    folder = undisturbed / a_run(setting=TINY_ONE_SHOT).folder
    assert sorted(path.name for path in folder.iterdir()) == ["models", "results.json"]
    actor = lw.load_actor(folder / "models" / "push.zip")
    result = lw.evaluate(actor, tasks="push", episodes_per_task=2, seed=10_003, max_steps=40, progress=False)
    assert result.success_once == lw.EvaluationResult.load(folder / "results.json").success_once


@pytest.mark.parametrize(("setting", "file"), [(TINY, "policy.zip"), (TINY_ONE_SHOT, "models/push.zip")])
@pytest.mark.parametrize("method", ["pcbc", "dc"])
def test_an_ensemble_has_members_of_its_own_and_is_not_trained_twice(undisturbed, tmp_path, method, setting, file):
    one = a_run(method, setting=setting, preset=ENSEMBLE)
    policy = lw.load_actor(undisturbed / one.folder / file)
    assert isinstance(policy, lw.modules.ActorEnsemble)
    assert [actor.config["width"] for actor in policy.members] == [32, 16]
    shutil.copytree(undisturbed, tmp_path / "again")
    (tmp_path / "again" / one.folder / "results.json").unlink()
    result = execute_short(one, tmp_path / "again", tasks=task_of(one))
    assert result.success_once == lw.EvaluationResult.load(undisturbed / one.folder / "results.json").success_once
    assert not list((tmp_path / "again" / one.folder).glob("checkpoint*"))


def test_actors_of_descriptions_are_for_the_tasks_that_were_demonstrated(tmp_path):
    turned = replace(OTHER, any_yaw=False, plan_yaw=10.0, tilt=0.5)
    preset = replace(PRESET, name="seen", members=(turned, turned), demonstrated=(MEMBER,))
    one = a_run(preset=preset)
    result = execute(one, tmp_path)
    policy = lw.load_actor(tmp_path / one.folder / "policy.zip")
    assert isinstance(policy, lw.modules.DemonstratedActor)
    assert isinstance(policy.others, lw.modules.ActorEnsemble)
    assert (policy.demonstrated.tasks, len(policy.tasks)) == (("reach",), 50)
    said = result.config["run"]
    assert said["members"] == [{"actor": {**OTHER.actor, **ROLES}, "yaw": 10.0, "tilt": 0.5}] * 2
    assert said["demonstrated"] == [{"actor": dict(MEMBER.actor), "yaw": 0.0}]
    (tmp_path / one.folder / "results.json").unlink()
    assert execute(one, tmp_path).success_once == result.success_once
    plain = a_run("dc", preset=preset)
    assert "demonstrated" not in plain.describe(PLANS)
    assert [member["yaw"] for member in plain.describe(PLANS)["members"]] == [0.3, 0.3]


@pytest.mark.parametrize(("setting", "file"), [(TINY, "policy.zip"), (TINY_ONE_SHOT, "models/push.zip")])
def test_a_policy_says_which_seed_its_demonstrations_had(undisturbed, setting, file):
    assert demonstration_seeds(undisturbed / a_run(setting=setting).folder / file) == {3}


@pytest.mark.parametrize("setting", [TINY, TINY_ONE_SHOT])
def test_a_policy_of_another_configuration_is_not_taken_for_this_one(undisturbed, tmp_path, setting):
    shutil.copytree(undisturbed, tmp_path / "again")
    one = a_run(setting=setting)
    folder = tmp_path / "again" / one.folder
    (folder / "results.json").unlink()
    (folder / "checkpoint-0.zip").write_bytes(b"left by a process that was killed")
    longer = replace(PRESET, training=replace(PRESET.training, steps=61))
    with pytest.raises(ValueError, match="is of another configuration, its run differs in training"):
        execute(one, tmp_path / "again", longer)
    execute(one, tmp_path / "again")
    assert rates(folder) == rates(undisturbed / one.folder)
    assert not (folder / "checkpoint-0.zip").exists()


def test_settings_are_the_papers():
    assert (SETTINGS["zero-shot"].base, SETTINGS["zero-shot"].episodes) == ("MT10", 100)
    assert (SETTINGS["few-shot"].base, SETTINGS["few-shot"].episodes) == ("MT50", 10)
    one_shot = SETTINGS["one-shot"]
    assert (one_shot.base, one_shot.episodes, one_shot.targets) == ("MT10", 100, "MT50")
    paper = PRESETS["paper"]["few-shot"]
    assert (paper.training.optimizer, paper.training.learning_rate, paper.training.momentum) == ("sgd", 1e-5, 0.995)
    assert paper.members[0].actor["width"] == (128, 128, 128, 64, 32)
    assert (paper.members[0].actor["encoder_width"], paper.members[0].actor["encoder_depth"]) == (64, 3)
    assert (paper.passes, paper.base.noise_scale) == (500, (0.0,))
    with pytest.raises(TypeError, match="does not support item assignment"):
        paper.members[0].actor["width"] = 8
    assert PRESETS["paper"]["one-shot"].base.noise_scale == (0.1, 0.2, 0.3, 0.4)
    for name, preset in PRESETS.items():
        alone = {"evaluator": {"few-shot"}, "one-network": {"few-shot"}, "no-roles": {"zero-shot"}}
        assert preset.keys() == alone.get(name, SETTINGS.keys())
        assert "one-shot" not in preset or preset["one-shot"].training.batch_size % 180 == 0
    with pytest.raises(ValueError, match=r"method must be one of 'pcbc', .*did you mean 'pcbc'"):
        ImitationRun(TINY, "pbc", 0, PRESET)


@pytest.mark.parametrize(
    ("setting", "trainer", "share"),
    [(TINY, "BehavioralCloningTrainer", 20), (TINY_ONE_SHOT, "StackedBehavioralCloning", 10)],
)
def test_passes_count_rows(undisturbed, tmp_path, monkeypatch, setting, trainer, share):
    (tmp_path / "demonstrations").symlink_to(undisturbed / "demonstrations")
    steps = []

    def stop(*_, **__):
        raise KeyboardInterrupt

    def see(*arguments, **_):
        steps.append(arguments[2].steps)
        stop()

    monkeypatch.setattr(imitation, trainer, see)
    with pytest.raises(KeyboardInterrupt):
        execute(a_run(setting=setting), tmp_path, replace(PRESET, passes=2))
    rows = len(lw.LanguageWorldExperienceReplay(tmp_path / a_run().datasets[0].folder, after_success=20))
    assert steps == [2 * rows // share]


@pytest.mark.parametrize(
    "one", [a_run(), a_run("dc"), a_run("one-hot", setting=TINY_ONE_SHOT)], ids=["pcbc", "dc", "one-hot one-shot"]
)
@pytest.mark.slow
def test_a_text_encoder_of_ones_own(one, tmp_path):
    own = replace(one, encoder_name="my_texts:lengths")
    assert own.folder != one.folder
    execute_short(own, tmp_path, tasks=task_of(own), text_encoder=lengths)
    (tmp_path / own.folder / "results.json").unlink()
    again = execute_short(own, tmp_path, tasks=task_of(own), text_encoder=lengths)
    assert again.config["run"]["text_encoder"] == "my_texts:lengths"
    if one.method == "dc":  # of canonical plans no text is read
        (tmp_path / own.folder / "results.json").unlink()
        with pytest.raises(ValueError, match="text"):  # a policy of other texts is no policy of these
            execute_short(own, tmp_path, tasks=task_of(own), text_encoder=backwards)
    for named, encoder in ((own, None), (one, lengths)):
        with pytest.raises(ValueError, match="text_encoder must be given where the run has an encoder_name"):
            execute_short(named, tmp_path, tasks=task_of(own), text_encoder=encoder)


def test_a_preset_may_put_an_evaluator_into_the_policy(tmp_path):
    one = a_run(preset=replace(EVALUATOR, training=replace(EVALUATOR.training, steps=2)))
    execute(one, tmp_path)
    policy = lw.load_actor(tmp_path / one.folder / "policy.zip")
    assert isinstance(policy.evaluator, lw.StateQueryEvaluator)
    assert policy.evaluator.config["width"] == 16
    assert "qaf" not in policy.in_keys
    assert (
        execute(one, tmp_path).mean_success
        == lw.EvaluationResult.load(tmp_path / one.folder / "results.json").mean_success
    )
