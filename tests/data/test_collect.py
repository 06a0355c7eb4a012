"""collect_demonstrations: the rows of a dataset; folders that are unfinished, in use or hold other content."""

import importlib.metadata
import json
import subprocess
import sys
import textwrap
from concurrent.futures import ThreadPoolExecutor

import metaworld
import numpy as np
import pytest
import torch
from collecting import EPISODES, NOISE, SEED, STEPS, TASKS, Evil, collect, interrupt_after, tree

import lw_torchrl as lw
from lw_torchrl._util.files import locked
from lw_torchrl._util.reproducibility import SIMULATORS, package_versions, version_changes
from lw_torchrl.data import CollectConfig, DatasetError
from lw_torchrl.data.collect import EpisodeFiles
from lw_torchrl.data.dataset import load_rows, read_metadata
from lw_torchrl.envs.rows import action_noise, episode_seed
from lw_torchrl.language.tasks import MT50
from lw_torchrl.suites.metaworld.environments import make_metaworld_env

CONFIG = CollectConfig(TASKS, EPISODES, SEED, noise_scale=NOISE, max_steps=STEPS)
REDRAW = dict(tasks="reach", episodes_per_task=3, max_steps=50, noise_scale=(0.4,))
CHANGES = dict(tasks="reach", episodes_per_task=4, seed=6, noise_scale=0.1, noise_hold=3)


def test_rows_have_the_documented_keys_shapes_and_dtypes(rows):
    total = len(TASKS) * EPISODES * STEPS
    expected = dict.fromkeys(["observation", ("next", "observation")], ((total, 39), torch.float32))
    expected |= dict.fromkeys(["action", "expert_action", "unclipped_action"], ((total, 4), torch.float32))
    numbers = ["task_id", "episode", ("collector", "traj_ids"), ("next", "task_id")]
    expected |= dict.fromkeys(numbers, ((total,), torch.int64))
    expected |= dict.fromkeys([("next", "reward_sparse"), ("next", "reward_dense")], ((total, 1), torch.float32))
    flags = ("success", "done", "terminated", "truncated")
    expected |= {("next", key): ((total, 1), torch.bool) for key in flags}
    assert rows.batch_size == (total,)
    assert {key: (tuple(rows[key].shape), rows[key].dtype) for key in rows.keys(True, True)} == expected


def test_episodes_are_consecutive_and_end_by_truncation(dataset, rows):
    assert [(e.task, e.episode) for e in dataset.episodes] == [(t, k) for t in TASKS for k in range(EPISODES)]
    ids = rows["collector", "traj_ids"].reshape(-1, STEPS)
    assert (ids == ids[:, :1]).all()
    assert ids[:, 0].unique().numel() == len(dataset.episodes)
    for number, episode in enumerate(dataset.episodes):
        assert (episode.start, episode.length) == (number * STEPS, STEPS)
        part = rows[episode.start : episode.start + episode.length]
        for key, value in (("task_id", MT50.index(episode.task)), ("episode", episode.episode)):
            assert (part[key] == value).all()
        assert torch.equal(part["next", "task_id"], part["task_id"])
        assert torch.equal(part["observation"][1:], part["next", "observation"][:-1])
        assert not part["next", "terminated"].any()
        for key in ("done", "truncated"):
            assert part["next", key].flatten().tolist() == [False] * (STEPS - 1) + [True]


def test_metadata_record_configuration_and_versions(dataset):
    assert dataset.config == CONFIG
    assert dataset.num_steps == len(TASKS) * EPISODES * STEPS
    metadata = json.loads((dataset.root / "metadata.json").read_text())
    assert metadata["config"] == CONFIG.to_json()
    packages = ("metaworld", "mujoco", "numpy", "tensordict", "torch", "torchrl")
    versions = {name: importlib.metadata.version(name) for name in packages}
    assert metadata["versions"] == versions | {"lw_torchrl": lw.__version__}
    assert read_metadata(dataset.root) == dataset
    assert metadata["task_ids"] == dataset.task_ids == {task: MT50.index(task) for task in TASKS}
    assert not (dataset.root / ".partial").exists()


def test_success_is_recorded_for_each_episode(tmp_path):
    dataset = collect(tmp_path / "demos", "reach", max_steps=50, episodes_per_task=4, noise_scale=0.0, seed=0)
    rows = load_rows(dataset)
    for episode in dataset.episodes:
        success = rows["next", "success"][episode.start : episode.start + episode.length].flatten().tolist()
        assert episode.success == any(success)
        assert episode.first_success == (success.index(True) + 1 if any(success) else None)
    rate = sum(e.success for e in dataset.episodes) / 4
    assert 0 < rate < 1, "the test needs successes and failures"
    assert dataset.success_rate == {"reach": rate}


@pytest.mark.parametrize("hold", [1, 4])
def test_executed_action_is_the_experts_plus_noise_clipped(tmp_path, hold):
    rows = load_rows(dataset := collect(tmp_path / "demos", noise_hold=hold))
    for episode in dataset.episodes:
        part = rows[episode.start : episode.start + STEPS]
        scale = NOISE[episode.episode % len(NOISE)]
        noise = action_noise(episode.task, SEED, episode.episode, -(-STEPS // hold)).repeat(hold, 0)[:STEPS]
        noise = torch.from_numpy(noise * np.float32([scale] * 3 + [scale * 0.2]))
        assert torch.equal(part["action"], (part["expert_action"] + noise).clamp(-1, 1))
        assert torch.equal(part["action"], part["expert_action"]) == (scale == 0)
        assert part["expert_action"].abs().max() <= 1


@pytest.mark.filterwarnings("ignore:Constant.s. may be too high")
@pytest.mark.parametrize("task", TASKS)
def test_unclipped_action_is_that_of_metaworlds_script(rows, task):
    script = metaworld.policies.ENV_POLICY_MAP[f"{task}-v3"]()
    part = rows[rows["task_id"] == MT50.index(task)]
    actions = [script.get_action(observation.astype(np.float64)) for observation in part["observation"].numpy()]
    assert np.array_equal(part["unclipped_action"].numpy(), np.stack(actions).astype(np.float32))
    assert torch.equal(part["unclipped_action"].clamp(-1, 1), part["expert_action"])
    assert rows["unclipped_action"].abs().max() > 1, "the test needs an action that is clipped"


@pytest.mark.parametrize("task", TASKS)
def test_stored_actions_reproduce_observations_and_rewards_in_metaworld(dataset, rows, task):
    env = make_metaworld_env(task)
    for episode in (e for e in dataset.episodes if e.task == task):
        part = rows[episode.start : episode.start + STEPS]
        env.seed(episode_seed(task, SEED, episode.episode))
        observation, _ = env.reset()
        for t in range(STEPS):
            assert np.array_equal(part["observation"][t].numpy(), observation.astype(np.float32))
            observation, reward, _, _, info = env.step(part["action"][t].numpy())
            assert np.array_equal(part["next", "observation"][t].numpy(), observation.astype(np.float32))
            assert part["next", "success"][t].item() == part["next", "reward_sparse"][t].item() == info["success"]
            assert part["next", "reward_dense"][t].item() == np.float32(reward)
    env.close()


@pytest.fixture(scope="module")
def redrawn(tmp_path_factory):
    return collect(tmp_path_factory.mktemp("redrawn") / "demos", redraw_failures=True, **REDRAW)


def test_redrawing_keeps_only_the_first_successes(redrawn, tmp_path):
    attempts = redrawn.attempts["reach"]
    everything = collect(tmp_path / "demos", **{**REDRAW, "episodes_per_task": attempts})
    successes = [e.episode for e in everything.episodes if e.success]
    assert len(successes) < attempts, "the test needs a failure"
    assert [e.episode for e in redrawn.episodes] == successes
    assert redrawn.success_rate == {"reach": 1.0}
    all_rows, kept_rows = load_rows(everything), load_rows(redrawn)
    expected = all_rows[torch.isin(all_rows["episode"], torch.tensor(successes))]
    assert (kept_rows.exclude("collector") == expected.exclude("collector")).all()


def test_redrawing_resumes_after_an_interruption(redrawn, tmp_path, monkeypatch):
    interrupt_after(monkeypatch, 2)
    with pytest.raises(KeyboardInterrupt):
        collect(tmp_path / "demos", redraw_failures=True, num_envs=1, **REDRAW)
    monkeypatch.undo()
    collect(tmp_path / "demos", redraw_failures=True, **REDRAW)
    assert tree(tmp_path / "demos") == tree(redrawn.root)


# A process that starts the same call again and again and kills it: it imports once and forks for each attempt.
KILLER = """
    import os, random, signal, sys, time
    import torch
    from lw_torchrl.data import collect_demonstrations
    root, mode = sys.argv[1:]
    options = dict(episodes_per_task=3, seed=5, noise_scale=(0.0, 0.3), max_steps=14, progress=False)
    options |= dict(num_envs=2)  # few rows, so that episodes finish one after another
    def die():
        os.kill(os.getpid(), signal.SIGKILL)
    def attempt(prepare):
        child = os.fork()
        if child == 0:
            try:
                prepare()
                collect_demonstrations(("push", "reach"), root=root, **options)
            except BaseException as error:
                print(repr(error), file=sys.stderr)
                os._exit(1)
            os._exit(0)
        return child
    def wait(child):
        status = os.waitpid(child, 0)[1]
        assert not os.WIFEXITED(status) or os.WEXITSTATUS(status) == 0, status
        return os.WIFSIGNALED(status)
    kills = 0
    if mode == "replace":
        # Before or after an os.replace, a later one in each attempt.
        real = os.replace
        for through in range(40):
            def prepare(left=[through // 2], after=through % 2):
                def replace(*args):
                    if not left[0] and not after:
                        die()
                    real(*args)
                    if not left[0]:
                        die()
                    left[0] -= 1
                os.replace = replace
            if not wait(attempt(prepare)):
                break
            kills += 1
        else:
            raise SystemExit("no attempt finished")
    else:
        draw = random.Random(mode)
        for _ in range(8):
            child = attempt(lambda: None)
            time.sleep(draw.uniform(0.0, 1.0))
            os.kill(child, signal.SIGKILL)
            kills += wait(child)
        wait(attempt(lambda: None))
    print(kills)
"""


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["replace", "seed 1"])
def test_repeated_kills_do_not_change_the_dataset(dataset, tmp_path, mode):
    root = tmp_path / "demos"
    command = [sys.executable, "-W", "ignore", "-c", textwrap.dedent(KILLER), str(root), mode]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) >= (5 if mode == "replace" else 1)
    assert tree(root) == tree(dataset.root)


@pytest.fixture
def half_made(tmp_path, monkeypatch):
    """A folder with four of the six episodes."""
    root = tmp_path / "half"
    interrupt_after(monkeypatch, 4)
    with pytest.raises(KeyboardInterrupt):
        collect(root, num_envs=2)
    monkeypatch.undo()
    return root


def test_resuming_runs_only_the_missing_episodes(half_made, dataset, monkeypatch):
    with pytest.raises(DatasetError, match="unfinished"):
        read_metadata(half_made)
    assert len(list((half_made / ".partial").glob("*.npz"))) == 4
    written, put = [], EpisodeFiles.put
    monkeypatch.setattr(EpisodeFiles, "put", lambda *args: written.append(args) or put(*args))
    collect(half_made)
    assert len(written) == 2
    assert tree(half_made) == tree(dataset.root)


def test_a_damaged_episode_file_is_named_and_a_pickle_in_it_never_executed(half_made, dataset, tmp_path):
    path = sorted((half_made / ".partial").glob("*.npz"))[0]
    content, arrays = path.read_bytes(), {**np.load(path)}
    arrays["observation"] = np.array([Evil(tmp_path / "executed")] * STEPS, dtype=object)
    np.savez(path, allow_pickle=True, **arrays)
    for damaged in (path.read_bytes(), content[:-100]):
        path.write_bytes(damaged)
        with pytest.raises(DatasetError, match=rf"{path.name}' is corrupted"):
            collect(half_made)
    assert not (tmp_path / "executed").exists()
    path.unlink()
    collect(half_made)
    assert tree(half_made) == tree(dataset.root)


def test_a_finished_dataset_is_not_run_again(dataset, monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("no episode should run")

    before = tree(dataset.root)
    monkeypatch.setattr("lw_torchrl.data.collect.LanguageWorldEnv", refuse)
    assert collect(dataset.root) == dataset
    assert tree(dataset.root) == before


CHANGES |= dict(gripper_noise_factor=1.0, redraw_failures=True, max_steps=15)


@pytest.mark.parametrize("name", CHANGES)
def test_another_configuration_is_an_error_with_the_difference(dataset, name):
    before = tree(dataset.root)
    with pytest.raises(DatasetError, match=rf"another configuration \({name} \(.*, now .*\)\); ") as caught:
        collect(dataset.root, **{name: CHANGES[name]})
    assert not any(f"{other} (" in str(caught.value) for other in CHANGES if other != name)
    assert tree(dataset.root) == before


def test_a_folder_with_other_files_is_an_error_and_does_not_change(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "precious.csv").write_text("1,2,3")
    before = tree(tmp_path)
    with pytest.raises(DatasetError, match="not empty"):
        collect(tmp_path)
    assert tree(tmp_path) == before


def elsewhere(root):
    """Collect in another thread, while this one waits."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(collect, root).result()


def test_a_second_call_is_an_error_while_the_first_runs(dataset, tmp_path, monkeypatch):
    put, calls = EpisodeFiles.put, []

    def meanwhile(self, *args):
        if not calls:
            calls.append(True)
            with pytest.raises(DatasetError, match="root: another collect_demonstrations is writing"):
                elsewhere(tmp_path / "demos")
        put(self, *args)

    monkeypatch.setattr(EpisodeFiles, "put", meanwhile)
    collect(tmp_path / "demos")
    assert calls
    assert tree(tmp_path / "demos") == tree(dataset.root)


def test_a_finished_dataset_is_read_while_another_process_holds_the_lock(dataset):
    with locked(dataset.root, "root", folder=True):
        assert elsewhere(dataset.root) == dataset


def test_version_changes():
    now = package_versions()
    assert {*SIMULATORS, "torch", "numpy", "lw_torchrl"} <= now.keys()
    assert version_changes(now, now) == []
    assert version_changes({**now, "mujoco": "3.2.0"}, now) == [f"mujoco 3.2.0, now {now['mujoco']}"]


def test_episodes_of_two_simulators_are_never_mixed(half_made, monkeypatch):
    recorded, real = package_versions(), importlib.metadata.version
    with monkeypatch.context() as patch:
        other = lambda name: "9.9.9" if name == "mujoco" else real(name)  # noqa: E731
        patch.setattr("lw_torchrl._util.reproducibility.version", other)
        with pytest.raises(DatasetError, match=rf"another simulator \(mujoco {recorded['mujoco']}, now 9.9.9\)"):
            collect(half_made)
    assert collect(half_made).versions == recorded
