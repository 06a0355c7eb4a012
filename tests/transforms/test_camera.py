"""CameraTransform: pictures of the rows that moved, every N steps."""

import pytest
import torch
from pictures import why_no_pictures
from torchrl.envs import SerialEnv, TransformedEnv, check_env_specs

import lw_torchrl as lw

SIZE = {"height": 24, "width": 32}


@pytest.fixture(scope="module", autouse=True)
def _needs_open_gl():
    if missing := why_no_pictures():
        pytest.skip(missing)


def opened(tasks=("reach", "drawer-open"), cameras="corner", every=1, **options):
    camera = lw.transforms.CameraTransform(cameras, every=every, **SIZE)
    return TransformedEnv(lw.LanguageWorldEnv(list(tasks), seed=5, **options), camera)


def drawn(env, camera="corner"):
    return env.base_env.render(camera=camera, **SIZE)


def moving(tensordict):
    rows = torch.arange(len(tensordict)).float().unsqueeze(-1)
    return tensordict.set("action", torch.tensor([[0.8, -0.6, 0.4, 0.5]]) * (-1) ** rows)


def test_specs_and_several_cameras_side_by_side():
    env = opened(cameras=("corner", "topview"))
    check_env_specs(env)
    state = env.reset()
    assert env.observation_spec["pixels"].shape == (2, 24, 64, 3)
    assert torch.equal(state["pixels"], torch.cat([drawn(env), drawn(env, "topview")], -2))
    env.close()


@pytest.mark.parametrize("every", [1, 3])
def test_picture_is_held_for_every_steps_and_renewed_at_a_reset(every):
    env = opened(every=every)
    state, shown, drawings = env.reset(), [], [drawn(env)]
    for _ in range(7):
        shown.append(state["pixels"])
        state = env.step(moving(state))["next"]
        drawings.append(drawn(env))
    for step in range(7):
        assert torch.equal(shown[step], drawings[step // every * every])
    assert not torch.equal(shown[0], shown[3])
    again = env.reset(state.set("_reset", torch.tensor([True, False])))
    assert torch.equal(again["pixels"][0], drawn(env)[0])
    assert torch.equal(again["pixels"][1], drawings[7 // every * every][1])
    env.close()


def test_rows_that_rest_are_not_rendered(monkeypatch):
    env = opened(num_envs=4)
    state, rendered = env.reset(), []
    render = env.base_env.render
    monkeypatch.setattr(env.base_env, "render", lambda **options: rendered.append(options["rows"]) or render(**options))
    before = state["pixels"].clone()
    moved = torch.tensor([False, True, True, False])
    after = env.step(moving(state).set("_step", moved))["next"]["pixels"]
    assert rendered == [[1, 2]]
    assert torch.equal(after[~moved], before[~moved])
    env.close()


def test_state_dict_holds_the_environments_and_requires_a_reset():
    env, other = opened(["reach"]), opened(["reach"])
    env.reset()
    state = env.state_dict()
    expected = env.reset()
    began = other.reset()
    other.load_state_dict(state)
    with pytest.raises(RuntimeError, match=r"reset"):
        other.step(moving(began))
    result = other.reset()
    assert result["episode"] == expected["episode"] == 1
    assert torch.equal(result["pixels"], expected["pixels"])
    env.close()
    other.close()


def test_camera_belongs_into_each_worker():
    env = SerialEnv(2, lambda: opened(["reach"]))
    assert env.reset()["pixels"].shape == (2, 1, 24, 32, 3)
    env.close()
    with pytest.raises(TypeError, match="worker"):
        TransformedEnv(SerialEnv(2, lambda: lw.LanguageWorldEnv("reach")), lw.transforms.CameraTransform())
