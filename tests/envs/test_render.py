"""render: pictures of the rows; rendering does not change the simulation."""

import re
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from pictures import why_no_pictures
from speed import first_fast
from torchrl.envs import TransformedEnv
from torchrl.record import PixelRenderTransform

import lw_torchrl as lw
from lw_torchrl._util.rendering import CAMERAS


@pytest.fixture(scope="module", autouse=True)
def _needs_open_gl():
    if missing := why_no_pictures():
        pytest.skip(missing)
    yield
    for env in OPENED:
        env.close(raise_if_closed=False)


OPENED = []


def opened(engine="vectorized", tasks=("reach", "drawer-open"), **options):
    OPENED.append(lw.LanguageWorldEnv(list(tasks), engine=engine, seed=3, **options))
    OPENED[-1].reset()
    return OPENED[-1]


@pytest.fixture(scope="module")
def both_engines():
    envs = [opened(engine) for engine in ("vectorized", "metaworld")]
    for env in envs:
        env.rollout(5, lambda td: td.set("action", torch.full((2, 4), 0.5)))
    return envs


@pytest.mark.parametrize("camera", CAMERAS)
def test_both_engines_render_the_same(both_engines, camera):
    pictures = [env.render(camera=camera, height=60, width=80) for env in both_engines]
    assert (pictures[0].shape, pictures[0].dtype) == ((2, 60, 80, 3), torch.uint8)
    assert torch.equal(*pictures)
    assert pictures[0].float().std() > 10  # not a single colour


def test_each_row_is_rendered_with_its_own_scene():
    """Rows of one model differ in the places of bodies and sites after a reset."""
    pictures = opened(tasks=["drawer-open"], num_envs=3).render(height=60, width=80)
    assert not torch.equal(pictures[0], pictures[1])
    single = opened(tasks=["drawer-open"])
    single.reset(episode=1)
    assert torch.equal(single.render(height=60, width=80)[0], pictures[1])


def test_rendering_does_not_change_the_simulation():
    seen, unseen = opened(), opened()
    states = [env.reset() for env in (seen, unseen)]
    generator = torch.Generator().manual_seed(0)
    for _ in range(8):
        seen.render(height=32, width=32)
        action = torch.rand(2, 4, generator=generator) * 2 - 1
        states = [env.step(td.set("action", action))["next"] for env, td in zip((seen, unseen), states, strict=True)]
        assert torch.equal(states[0]["observation"], states[1]["observation"])


def test_sizes_may_alternate_and_two_environments_may_render():
    first, second = opened(), opened(tasks=["push"])
    small, other = first.render(height=24, width=32), second.render(height=24, width=32)
    large = first.render(height=700, width=900)
    assert large.shape == (2, 700, 900, 3)
    assert large.float().std(dim=(1, 2, 3)).min() > 10  # two models, and more pixels than MuJoCo's own buffer
    assert torch.equal(first.render(height=24, width=32), small)
    first.close()
    assert torch.equal(second.render(height=24, width=32), other)


def test_two_threads_may_render_in_turn():
    env = opened()
    with ThreadPoolExecutor(2) as pool:
        here = env.render(height=24, width=32)
        there = pool.submit(env.render, height=24, width=32).result()
        pool.submit(env.close).result()
    assert torch.equal(here, there)


FORK = """
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

env = lw.LanguageWorldEnv("reach")
env.reset()
env.render(height=24, width=32)
child = mp.get_context("fork").Process(target=show)
child.start()
child.join(60)
child.kill()
"""


@pytest.mark.slow
def test_rendering_in_a_process_forked_after_rendering_is_an_error(python):
    out = python(FORK).stdout
    assert "fork" in out
    assert out.endswith("closed\n")


def test_reading_the_spec_first_keeps_pixels_in_one_episode():
    pixels = PixelRenderTransform(height=24, width=32)
    env = TransformedEnv(lw.LanguageWorldEnv(["reach", "push"], num_threads=1), pixels)
    assert env.observation_spec["pixels"].shape == (2, 24, 32, 3)
    rollout = env.rollout(3)
    assert torch.equal(rollout["episode"], rollout["next", "episode"])
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize("backend", first_fast(["glfw", "disable"]))
def test_the_error_without_opengl_names_what_to_install(backend, python):
    program = "import lw_torchrl as lw; env = lw.LanguageWorldEnv('reach'); env.reset(); env.render()"
    error = python(program, MUJOCO_GL=backend, DISPLAY="", WAYLAND_DISPLAY="").stderr
    assert re.search(rf"^ImportError: .*MUJOCO_GL={backend}.*MUJOCO_GL=egl", error, re.MULTILINE)
