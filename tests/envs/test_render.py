"""render: what cameras see of the rows, with TorchRL's recorder; nothing in the simulation moves."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from pictures import why_no_pictures
from speed import first_fast
from torchrl.envs import Compose, StepCounter, TransformedEnv, check_env_specs
from torchrl.record import PixelRenderTransform, VideoRecorder
from torchrl.record.loggers import CSVLogger

import lw_torchrl as lw
from lw_torchrl._util.rendering import CAMERAS


@pytest.fixture(scope="module", autouse=True)
def _needs_open_gl():
    if missing := why_no_pictures():
        pytest.skip(missing)


def opened(engine="vectorized", tasks=("reach", "drawer-open"), **options):
    env = lw.LanguageWorldEnv(list(tasks), engine=engine, seed=3, **options)
    env.reset()
    return env


@pytest.fixture(scope="module")
def both_engines():
    envs = [opened(engine) for engine in ("vectorized", "metaworld")]
    for env in envs:
        env.rollout(5, lambda td: td.set("action", torch.full((2, 4), 0.5)))
    yield envs
    for env in envs:
        env.close()


@pytest.mark.parametrize("camera", CAMERAS)
def test_both_engines_show_the_same(both_engines, camera):
    seen = [env.render(camera=camera, height=60, width=80) for env in both_engines]
    assert seen[0].shape == (2, 60, 80, 3)
    assert seen[0].dtype == torch.uint8
    assert torch.equal(*seen)
    assert seen[0].float().std() > 10  # there is something to see


def test_a_row_is_seen_with_its_own_scene():
    """Rows of one model differ in where a reset has put bodies and sites."""
    env = opened(tasks=["drawer-open"], num_envs=3)
    pictures = env.render(height=60, width=80)
    assert not torch.equal(pictures[0], pictures[1])
    alone = lw.LanguageWorldEnv("drawer-open", seed=3)
    alone.reset(episode=1)
    assert torch.equal(alone.render(height=60, width=80)[0], pictures[1])
    env.close()
    alone.close()


def test_the_robot_is_upright():
    """Sawyer is red: from the side its base is below its hand, and the floor is at the bottom."""
    env = opened(tasks=["reach"])
    for camera in ("corner", "corner2", "corner3", "behindGripper"):
        picture = env.render(camera=camera, height=120, width=160)[0].float()
        grey_sky = (picture - picture[:1, :1]).abs().sum(-1) < 30
        if camera != "corner3":
            assert grey_sky[:20].float().mean() > grey_sky[-20:].float().mean()
    env.close()


def test_pictures_change_nothing():
    def states(look):
        env = opened()
        found = []
        generator = torch.Generator().manual_seed(0)
        state = env.reset()
        for _ in range(8):
            if look:
                env.render(height=32, width=32)
            state["action"] = torch.rand(2, 4, generator=generator) * 2 - 1
            state = env.step(state)["next"]
            found.append(state["observation"])
        env.close()
        return torch.stack(found)

    assert torch.equal(states(look=True), states(look=False))


def test_sizes_may_alternate_and_two_environments_stand_side_by_side():
    first, second = opened(), opened(tasks=["push"])
    small, other = first.render(height=24, width=32), second.render(height=24, width=32)
    large = first.render(height=700, width=900)
    assert large.shape == (2, 700, 900, 3)
    assert large.float().std(dim=(1, 2, 3)).min() > 10  # of more than one model, and larger than MuJoCo's own buffer
    assert torch.equal(first.render(height=24, width=32), small)
    first.close()
    assert torch.equal(second.render(height=24, width=32), other)
    second.close()


def test_a_single_environment_and_torchrls_video(tmp_path):
    recorder = VideoRecorder(CSVLogger("seen", log_dir=str(tmp_path), video_format="pt"), tag="pixels", skip=1)
    env = TransformedEnv(
        lw.LanguageWorldEnv("reach", batch_size=(), max_steps=6),
        Compose(PixelRenderTransform(height=24, width=32), recorder, StepCounter()),
    )
    rollout = env.rollout(6)
    env.transform.dump()
    (video,) = (torch.load(path) for path in tmp_path.rglob("*.pt"))
    frames = torch.cat([rollout["pixels"][:1], rollout["next", "pixels"]])
    assert torch.equal(video.reshape(-1, 3, 24, 32)[-7:], frames.permute(0, 3, 1, 2))
    env.close()


def test_pixels_of_all_rows_are_a_key_like_any():
    env = TransformedEnv(lw.LanguageWorldEnv(["reach", "push"]), PixelRenderTransform(height=24, width=32))
    check_env_specs(env)
    rollout = env.rollout(3)
    assert rollout["pixels"].shape == (2, 3, 24, 32, 3)
    assert rollout["next", "pixels"].dtype == torch.uint8
    assert not torch.equal(rollout["pixels"][0], rollout["pixels"][1])
    env.close()


def test_there_is_nothing_to_see_before_a_reset_or_after_the_end():
    env = lw.LanguageWorldEnv("reach")
    with pytest.raises(RuntimeError, match="before a reset"):
        env.render()
    env.reset()
    env.close()
    with pytest.raises(RuntimeError, match="before a reset"):
        env.render()


def test_an_engine_of_ones_own_need_not_draw():
    class Still:
        def __init__(self, tasks, **_):
            self.n = len(tasks)

        def reset(self, rows, seeds):
            return np.zeros((len(rows), 39))

        def close(self):
            pass

    env = lw.LanguageWorldEnv("reach", engine=Still)
    env.reset()
    with pytest.raises(NotImplementedError, match="Still has no render"):
        env.render()
    env.close()


_SHOW = """
import lw_torchrl as lw
env = lw.LanguageWorldEnv("reach")
env.reset()
try:
    env.render()
except ImportError as error:
    print("ImportError:", error)
env.close()
"""


def test_one_thread_takes_pictures_and_then_another():
    env = opened()
    with ThreadPoolExecutor(2) as pool:
        here = env.render(height=24, width=32)
        there = pool.submit(env.render, height=24, width=32).result()
        pool.submit(env.close).result()
    assert torch.equal(here, there)


_FORK = """
import multiprocessing as mp
import lw_torchrl as lw

def show():
    mine = lw.LanguageWorldEnv("reach")
    mine.reset()
    try:
        mine.render(height=24, width=32)
    except RuntimeError as error:
        print(error, flush=True)
    env.close()
    print("closed", flush=True)

if __name__ == "__main__":
    env = lw.LanguageWorldEnv("reach")
    env.reset()
    env.render(height=24, width=32)
    child = mp.get_context("fork").Process(target=show)
    child.start()
    child.join(60)
    child.kill()
"""


@pytest.mark.slow
def test_a_process_forked_after_a_picture_is_told_and_does_not_hang():
    done = subprocess.run([sys.executable, "-c", _FORK], capture_output=True, text=True, check=True)
    assert "forked from one that rendered" in done.stdout
    assert done.stdout.endswith("closed\n")


def test_pixels_are_of_one_episode_once_the_specs_are_known():
    pixels = PixelRenderTransform(height=24, width=32)
    env = TransformedEnv(lw.LanguageWorldEnv(["reach", "push"], num_threads=1), pixels)
    assert env.observation_spec["pixels"].shape == (2, 24, 32, 3)
    rollout = env.rollout(3)
    assert torch.equal(rollout["episode"], rollout["next", "episode"])
    env.close()


@pytest.mark.slow
def test_an_environment_left_open_ends_in_silence():
    done = subprocess.run(
        [sys.executable, "-c", _SHOW.replace("env.close()", "")], capture_output=True, text=True, check=True
    )
    assert not done.stderr


@pytest.mark.parametrize("backend", first_fast(["glfw", "disable"]))
def test_without_open_gl_the_error_says_what_to_install(backend):
    environment = {**os.environ, "MUJOCO_GL": backend}
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        environment.pop(name, None)
    done = subprocess.run([sys.executable, "-c", _SHOW], env=environment, capture_output=True, text=True, check=True)
    assert f"MUJOCO_GL={backend}" in done.stdout
    assert "MUJOCO_GL=egl" in done.stdout
    assert "Traceback" not in done.stderr


@pytest.mark.slow
def test_a_library_may_ask_for_egl_after_mujoco_was_imported():
    asking_late = "import mujoco, os\nos.environ['MUJOCO_GL'] = 'egl'  # as robosuite does\n" + _SHOW
    environment = {name: value for name, value in os.environ.items() if name != "MUJOCO_GL"}
    done = subprocess.run([sys.executable, "-c", asking_late], env=environment, capture_output=True, text=True)
    assert "camera images need OpenGL" not in done.stdout + done.stderr
    assert not done.returncode
