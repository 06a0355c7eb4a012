"""Demonstrations: what they hold, and that neither rows, interruptions nor damage change them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import textwrap
import zipfile
from importlib.metadata import version

import metaworld
import numpy as np
import pytest
import torch

from lw_torchrl.data import CollectConfig, DatasetError, collect_demonstrations
from lw_torchrl.data import collect as collect_module
from lw_torchrl.data.metadata import read_metadata
from lw_torchrl.data.rows import load_rows
from lw_torchrl.envs.engines.metaworld import make_metaworld_env
from lw_torchrl.envs.experts import ExpertActor
from lw_torchrl.envs.language_world_env import LanguageWorldEnv
from lw_torchrl.envs.seeding import action_noise, episode_seed
from lw_torchrl.language.tasks import MT50

TASKS = ("push", "reach")
NOISE = (0.0, 0.3)
STEPS, EPISODES, SEED = 14, 3, 5
CONFIG = CollectConfig(TASKS, EPISODES, SEED, noise_scale=NOISE, max_steps=STEPS)


def collect(root, tasks=TASKS, **changed):
    options = dict(episodes_per_task=EPISODES, seed=SEED, noise_scale=NOISE, max_steps=STEPS, progress=False)
    return collect_demonstrations(tasks, root=root, **{**options, **changed})


def tree(root):
    """Every file below a folder with its bytes."""
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return collect(tmp_path_factory.mktemp("made") / "demos")


@pytest.fixture(scope="module")
def rows(made):
    return load_rows(made)


# ---- what a dataset holds


def test_the_rows_have_the_documented_keys_shapes_and_dtypes(rows):
    total = len(TASKS) * EPISODES * STEPS
    number, flag = torch.int64, torch.bool
    expected = {
        "observation": ((total, 39), torch.float32),
        "task_id": ((total,), number),
        "episode": ((total,), number),
        "action": ((total, 4), torch.float32),
        "expert_action": ((total, 4), torch.float32),
        "unclipped_action": ((total, 4), torch.float32),
        ("collector", "traj_ids"): ((total,), number),
        ("next", "observation"): ((total, 39), torch.float32),
        ("next", "task_id"): ((total,), number),
        ("next", "reward_sparse"): ((total, 1), torch.float32),
        ("next", "reward_dense"): ((total, 1), torch.float32),
        **{("next", key): ((total, 1), flag) for key in ("success", "done", "terminated", "truncated")},
    }
    assert rows.batch_size == (total,)
    found = {key: (tuple(rows[key].shape), rows[key].dtype) for key in rows.keys(True, True)}
    assert found == expected


def test_episodes_lie_one_after_another_and_end_by_truncation(made, rows):
    assert [(e.task, e.episode) for e in made.episodes] == [(t, k) for t in TASKS for k in range(EPISODES)]
    ids = rows["collector", "traj_ids"].reshape(-1, STEPS)
    assert (ids == ids[:, :1]).all()
    assert ids[:, 0].unique().numel() == len(made.episodes)
    for number, episode in enumerate(made.episodes):
        assert (episode.start, episode.length) == (number * STEPS, STEPS)
        part = rows[episode.start : episode.start + episode.length]
        assert (part["task_id"] == MT50.index(episode.task)).all()
        assert (part["next", "task_id"] == MT50.index(episode.task)).all()
        assert (part["episode"] == episode.episode).all()
        assert torch.equal(part["observation"][1:], part["next", "observation"][:-1])
        assert not part["next", "terminated"].any()
        for key in ("done", "truncated"):
            assert part["next", key].flatten().tolist() == [False] * (STEPS - 1) + [True]


@pytest.mark.parametrize("kind", ["sparse", "dense"])
@pytest.mark.parametrize("task", TASKS)
def test_both_rewards_are_those_of_an_environment_with_that_reward(made, rows, task, kind):
    env = LanguageWorldEnv(task, num_envs=EPISODES, seed=SEED, max_steps=STEPS, reward=kind)
    first = next(episode.start for episode in made.episodes if episode.task == task)
    part = rows[first : first + EPISODES * STEPS].reshape(EPISODES, STEPS)
    state = env.reset()
    assert torch.equal(state["episode"], part["episode"][:, 0])
    for t in range(STEPS):
        state = env.step(state.set("action", part["action"][:, t].clone()))["next"]
        assert torch.equal(state["reward"], part["next", f"reward_{kind}"][:, t])
    assert kind == "sparse" or part["next", "reward_dense"].unique().numel() > STEPS
    env.close()


def test_the_metadata_say_how_it_was_made(made, tmp_path):
    assert made.config == CONFIG
    assert made.num_steps == len(TASKS) * EPISODES * STEPS
    found = json.loads((made.root / "metadata.json").read_text())
    assert found["config"] == CONFIG.to_json()
    assert found["config"]["seed"] == SEED
    packages = ("lw_torchrl", "metaworld", "mujoco", "numpy", "tensordict", "torch", "torchrl")
    assert found["versions"] == {name: version(name) for name in packages}
    assert read_metadata(made.root) == made
    assert found["task_ids"] == made.task_ids == {task: MT50.index(task) for task in TASKS}
    assert not (made.root / ".partial").exists()


def test_success_is_recorded_episode_by_episode(tmp_path):
    made = collect(tmp_path / "demos", "reach", max_steps=50, episodes_per_task=4, noise_scale=0.0, seed=0)
    rows = load_rows(made)
    for episode in made.episodes:
        hits = rows["next", "success"][episode.start : episode.start + episode.length].flatten().nonzero().flatten()
        assert episode.success == (len(hits) > 0)
        assert episode.first_success == (int(hits[0]) + 1 if len(hits) else None)
    rate = sum(e.success for e in made.episodes) / 4
    assert 0 < rate < 1, "the test wants successes and failures"
    assert made.success_rate == {"reach": rate}


# ---- actions


def test_the_executed_action_is_the_experts_plus_the_episodes_own_noise_clipped(made, rows):
    for episode in made.episodes:
        part = rows[episode.start : episode.start + STEPS]
        scale = NOISE[episode.episode % len(NOISE)]
        noise = action_noise(episode.task, SEED, episode.episode, STEPS) * np.float32([scale] * 3 + [scale * 0.2])
        expected = (part["expert_action"] + torch.from_numpy(noise)).clamp(-1, 1)
        assert torch.equal(part["action"], expected)
        assert torch.equal(part["action"], part["expert_action"]) == (scale == 0)
        assert part["action"].abs().max() <= 1
        assert part["expert_action"].abs().max() <= 1


def test_held_noise_keeps_each_draw(tmp_path):
    made = collect(tmp_path / "demos", "reach", episodes_per_task=2, noise_scale=0.05, noise_hold=4, seed=2)
    rows = load_rows(made)
    draws = action_noise("reach", 2, 1, 4) * np.float32([0.05, 0.05, 0.05, 0.01])
    part = rows[STEPS:]
    expected = (part["expert_action"] + torch.from_numpy(draws.repeat(4, 0)[:STEPS])).clamp(-1, 1)
    assert torch.equal(part["action"], expected)


def test_the_expert_action_is_what_the_expert_wants_in_the_stored_state(rows):
    wanted = ExpertActor(TASKS)(rows.select("observation", "task_id").clone())["action"]
    assert torch.equal(wanted, rows["expert_action"])


@pytest.mark.filterwarnings("ignore:Constant.s. may be too high")
@pytest.mark.parametrize("task", TASKS)
def test_the_unclipped_action_is_what_meta_worlds_own_script_asks_for(rows, task):
    script = metaworld.policies.ENV_POLICY_MAP[f"{task}-v3"]()
    part = rows[rows["task_id"] == MT50.index(task)]
    asked = [script.get_action(observation.astype(np.float64)) for observation in part["observation"].numpy()]
    assert np.array_equal(part["unclipped_action"].numpy(), np.stack(asked).astype(np.float32))
    assert torch.equal(part["unclipped_action"].clamp(-1, 1), part["expert_action"])
    assert rows["unclipped_action"].abs().max() > 1, "the test wants an action that is clipped"


@pytest.mark.parametrize("task", TASKS)
def test_replayed_in_meta_worlds_own_environment_the_actions_give_the_observations(made, rows, task):
    env = make_metaworld_env(task)
    for episode in (e for e in made.episodes if e.task == task):
        part = rows[episode.start : episode.start + STEPS]
        env.seed(episode_seed(task, SEED, episode.episode))
        observation, _ = env.reset()
        for t in range(STEPS):
            assert np.array_equal(part["observation"][t].numpy(), observation.astype(np.float32))
            observation, _, _, _, info = env.step(part["action"][t].numpy())
            assert np.array_equal(part["next", "observation"][t].numpy(), observation.astype(np.float32))
            assert bool(part["next", "success"][t]) == bool(info["success"])
    env.close()


def test_a_single_number_is_the_same_as_a_sequence_of_one(tmp_path):
    one, other = tmp_path / "one", tmp_path / "other"
    collect(one, "reach", episodes_per_task=1, noise_scale=0.3)
    collect(other, "reach", episodes_per_task=1, noise_scale=[0.3])
    assert tree(one) == tree(other)


# ---- it does not depend on


@pytest.mark.parametrize("num_envs", [2, 5, 9])
def test_the_number_of_environments_changes_nothing(made, tmp_path, num_envs):
    collect(tmp_path / "demos", num_envs=num_envs)
    assert tree(tmp_path / "demos") == tree(made.root)


def test_a_tasks_rows_do_not_depend_on_the_tasks_beside_it(rows, tmp_path):
    alone = load_rows(collect(tmp_path / "demos", "reach")).exclude("collector")
    beside = rows[rows["task_id"] == MT50.index("reach")].exclude("collector")
    assert (alone == beside).all()


def test_another_seed_gives_other_episodes(rows, tmp_path):
    other = load_rows(collect(tmp_path / "demos", "reach", episodes_per_task=1, seed=SEED + 1))
    mine = rows[rows["task_id"] == MT50.index("reach")][:STEPS]
    assert not torch.equal(other["observation"][0, 36:], mine["observation"][0, 36:])


# ---- redrawing failures

REDRAW = dict(tasks="reach", episodes_per_task=3, max_steps=50, noise_scale=(0.4,))


@pytest.fixture(scope="module")
def redrawn(tmp_path_factory):
    return collect(tmp_path_factory.mktemp("redrawn") / "demos", redraw_failures=True, **REDRAW)


def test_redrawing_keeps_the_first_successes_and_only_them(redrawn, tmp_path):
    attempts = redrawn.attempts["reach"]
    everything = collect(tmp_path / "demos", **{**REDRAW, "episodes_per_task": attempts})
    good = [e.episode for e in everything.episodes if e.success]
    assert len(good) < attempts, "the test wants a failure among the episodes"
    assert [e.episode for e in redrawn.episodes] == good
    assert redrawn.success_rate == {"reach": 1.0}
    all_rows, kept = load_rows(everything), load_rows(redrawn)
    same = all_rows[torch.isin(all_rows["episode"], torch.tensor(good))].exclude("collector")
    assert (kept.exclude("collector") == same).all()


@pytest.mark.parametrize("num_envs", [1, 4])
def test_redrawing_is_the_same_with_any_number_of_environments(redrawn, tmp_path, num_envs):
    collect(tmp_path / "demos", redraw_failures=True, num_envs=num_envs, **REDRAW)
    assert tree(tmp_path / "demos") == tree(redrawn.root)


def test_redrawing_carries_on_after_an_interruption(redrawn, tmp_path, monkeypatch):
    interrupt_after(monkeypatch, 2)
    with pytest.raises(KeyboardInterrupt):
        collect(tmp_path / "demos", redraw_failures=True, num_envs=1, **REDRAW)
    monkeypatch.undo()
    collect(tmp_path / "demos", redraw_failures=True, **REDRAW)
    assert tree(tmp_path / "demos") == tree(redrawn.root)


def test_redrawing_gives_up_where_nothing_succeeds(tmp_path):
    with pytest.raises(RuntimeError, match=r"'reach'.*0 of 20 .*noise_scale"):
        collect(tmp_path / "demos", "reach", episodes_per_task=1, max_steps=1, redraw_failures=True)


# ---- interruptions


def interrupt_after(monkeypatch, episodes):
    """Stop collecting, as Ctrl-C does, after so many episodes have been put away."""
    put, left = collect_module.EpisodeFiles.put, [episodes]

    def stopping(self, *args):
        if not left[0]:
            raise KeyboardInterrupt
        left[0] -= 1
        put(self, *args)

    monkeypatch.setattr(collect_module.EpisodeFiles, "put", stopping)


# One process that starts the same call again and again and kills it: importing once, forking for each try.
KILLER = """
    import os, random, signal, sys, time
    import torch
    from lw_torchrl.data import collect_demonstrations

    root, mode = sys.argv[1:]
    options = dict(episodes_per_task=3, seed=5, noise_scale=(0.0, 0.3), max_steps=14, progress=False)
    options |= dict(num_envs=2)  # few rows, so that episodes are put away one after another

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
        # At an os.replace, before or after it, which one moves on with the tries.
        real = os.replace
        for after in (False, True) * 2:
            def prepare(after=after):
                def replace(*args):
                    if not after:
                        die()
                    real(*args)
                    die()
                os.replace = replace
            kills += wait(attempt(prepare))
        for through in range(40):
            def prepare(through=through):
                left = [through // 3]
                def replace(*args):
                    if not left[0]:
                        die()
                    left[0] -= 1
                    real(*args)
                os.replace = replace
            if not wait(attempt(prepare)):
                break
            kills += 1
        else:
            raise SystemExit("it never ended")
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


@pytest.mark.parametrize("mode", ["replace", "seed 1"])
def test_killed_again_and_again_it_gives_the_same_dataset(made, tmp_path, mode):
    root = tmp_path / "demos"
    command = [sys.executable, "-W", "ignore", "-c", textwrap.dedent(KILLER), str(root), mode]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) >= (5 if mode == "replace" else 1)
    assert tree(root) == tree(made.root)


@pytest.fixture
def half_made(tmp_path, monkeypatch):
    """A folder in which four of the six episodes are done."""
    root = tmp_path / "half"
    interrupt_after(monkeypatch, 4)
    with pytest.raises(KeyboardInterrupt):
        collect(root, num_envs=2)
    monkeypatch.undo()
    return root


def test_an_interrupted_dataset_carries_on_without_doing_episodes_twice(half_made, made, monkeypatch):
    with pytest.raises(DatasetError, match="half-written"):
        read_metadata(half_made)
    shards = list((half_made / ".partial").glob("*.npz"))
    assert len(shards) == 4
    done = []
    put = collect_module.EpisodeFiles.put
    monkeypatch.setattr(
        collect_module.EpisodeFiles,
        "put",
        lambda self, task, episode, steps: (done.append(task), put(self, task, episode, steps)),
    )
    collect(half_made)
    assert len(done) == 2
    assert tree(half_made) == tree(made.root)


def truncate(path):
    path.write_bytes(path.read_bytes()[:-100])


def empty(path):
    path.write_bytes(b"")


def scribble(path):
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 8] = bytes(byte ^ 0xFF for byte in content[middle : middle + 8])
    path.write_bytes(bytes(content))


def foreign(path):
    with replaced_zip(path) as archive:
        archive.writestr("hello.txt", "nothing of ours")


def replaced_zip(path):
    path.unlink()
    return zipfile.ZipFile(path, "w")


@pytest.mark.parametrize("damage", [truncate, empty, scribble, foreign])
def test_a_damaged_episode_is_done_again(half_made, made, damage):
    damage(sorted((half_made / ".partial").glob("*.npz"))[0])
    collect(half_made)
    assert tree(half_made) == tree(made.root)


def test_no_pickle_in_an_episodes_file_is_ever_executed(half_made, made, tmp_path):
    class Evil:
        def __reduce__(self):
            return (os.mkdir, (str(tmp_path / "executed"),))

    shard = sorted((half_made / ".partial").glob("*.npz"))[0]
    with np.load(shard) as found:
        arrays = {key: found[key] for key in found.files}
    arrays["observation"] = np.array([Evil()] * STEPS, dtype=object)
    np.savez(shard, allow_pickle=True, **arrays)
    collect(half_made)
    assert not (tmp_path / "executed").exists()
    assert tree(half_made) == tree(made.root)


# ---- called again


def test_a_finished_dataset_is_returned_at_once(made, monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("nothing is to be simulated")

    before = tree(made.root)
    monkeypatch.setattr(collect_module, "LanguageWorldEnv", refuse)
    assert collect(made.root) == made
    assert tree(made.root) == before


CHANGES = {
    "tasks": (dict(tasks="reach"), r"tasks \['push', 'reach'\], now \['reach'\]"),
    "episodes_per_task": (dict(episodes_per_task=4), r"episodes_per_task 3, now 4"),
    "seed": (dict(seed=6), "seed 5, now 6"),
    "noise_scale": (dict(noise_scale=0.1), r"noise_scale \[0.0, 0.3\], now \[0.1\]"),
    "noise_hold": (dict(noise_hold=3), "noise_hold 1, now 3"),
    "gripper_noise_factor": (dict(gripper_noise_factor=1.0), r"gripper_noise_factor 0.2, now 1.0"),
    "redraw_failures": (dict(redraw_failures=True), "redraw_failures False, now True"),
    "max_steps": (dict(max_steps=15), "max_steps 14, now 15"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_another_configuration_is_refused_with_what_differs(made, name):
    changed, message = CHANGES[name]
    before = tree(made.root)
    with pytest.raises(DatasetError, match=message) as caught:
        collect(made.root, **changed)
    assert not any(f"{other} " in str(caught.value).split("(")[1] for other in CHANGES if other != name)
    assert tree(made.root) == before


@pytest.mark.parametrize("name", CHANGES)
def test_another_configuration_is_refused_of_a_half_made_dataset_too(tmp_path, name, monkeypatch):
    root = tmp_path / "half"
    interrupt_after(monkeypatch, 0)
    with pytest.raises(KeyboardInterrupt):
        collect(root)
    before = tree(root)
    with pytest.raises(DatasetError, match=CHANGES[name][1]):
        collect(root, **CHANGES[name][0])
    assert tree(root) == before


def test_a_damaged_configuration_of_a_half_made_dataset_is_named(half_made):
    stated = half_made / ".partial" / "config.json"
    stated.write_text(stated.read_text()[:20])
    before = tree(half_made)
    with pytest.raises(DatasetError, match=r"root: .*half.*damaged"):
        collect(half_made)
    assert tree(half_made) == before


def test_a_folder_with_other_things_is_refused_and_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "precious.csv").write_text("1,2,3")
    before = tree(tmp_path)
    with pytest.raises(DatasetError, match="not empty"):
        collect(tmp_path)
    assert tree(tmp_path) == before


def test_a_file_in_place_of_the_folder_is_refused(tmp_path):
    path = tmp_path / "demos"
    path.write_text("a file")
    with pytest.raises(ValueError, match="root must be a folder"):
        collect(path)
    assert path.read_text() == "a file"


def test_an_empty_folder_is_fine(tmp_path, made):
    assert collect(tmp_path).episodes == made.episodes


# ---- arguments


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (dict(tasks="raech"), "reach"),
        (dict(tasks=[]), "tasks"),
        (dict(episodes_per_task=0), "episodes_per_task must be at least 1, got 0"),
        (dict(max_steps=0), "max_steps must be at least 1, got 0"),
        (dict(noise_scale=-0.1), "noise_scale must be finite and at least 0, got -0.1"),
        (dict(noise_scale=float("nan")), "noise_scale"),
        (dict(noise_hold=0), "noise_hold must be at least 1, got 0"),
        (dict(noise_scale=()), "noise_scale must hold at least one number"),
        (dict(gripper_noise_factor=-1), "gripper_noise_factor"),
        (dict(num_envs=1), "num_envs must be at least the number of tasks, 2, got 1"),
        (dict(num_envs=0), "num_envs must be at least 1, got 0"),
    ],
)
def test_wrong_arguments_are_named(tmp_path, changed, message):
    with pytest.raises(ValueError, match=message):
        collect(tmp_path / "demos", **changed)


@pytest.mark.parametrize("changed", [dict(episodes_per_task=2.0), dict(seed="0"), dict(noise_scale=["0.1"])])
def test_wrong_types_are_named(tmp_path, changed):
    with pytest.raises(TypeError, match=next(iter(changed))):
        collect(tmp_path / "demos", **changed)
    assert not (tmp_path / "demos").exists()
