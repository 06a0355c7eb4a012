"""python -m benchmarks.scene_pictures: draw the recorded scenes of six tasks next to MuJoCo's images."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")

import matplotlib.pyplot as plt
import mujoco
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
import torch
import tyro
from rerun.experimental import ViewerClient

import lw_torchrl as lw
from lw_torchrl.envs.rows import episode_seed
from lw_torchrl.record.entities import STEP_TIME
from lw_torchrl.record.meshes import Motion, log_motion
from lw_torchrl.suites.metaworld.vectorized_engine import VectorizedEngine

EYE, TARGET = np.array([0.75, 0.0, 0.65]), np.array([-0.05, 0.6, 0.15])
FIELD_OF_VIEW = 55.0  # degrees, of Rerun's camera
WIDTH, HEIGHT = 440, 330


@dataclass(frozen=True)
class Arguments:
    """Draw six tasks at the first success of an expert: the recorded scene on the left, MuJoCo's image on the right."""

    tasks: tuple[str, ...] = ("drawer-open", "window-close", "hammer", "peg-insert-side", "basketball", "coffee-pull")
    out: Path = Path("runs/scene.png")
    seed: int = 0


def _at_success(task: str, seed: int) -> tuple[Motion, Any]:
    """Return the poses of the bodies at the first success of an expert, as one row, and MuJoCo's image."""
    with torch.no_grad():
        env = lw.LanguageWorldEnv(task, seed=seed, num_threads=1)
        rollout = env.rollout(200, lw.ExpertActor(task))[0]
        env.close()
    success = rollout["next", "success"].flatten()
    steps = int(success.int().argmax()) + 1 if success.any() else len(rollout)
    engine = VectorizedEngine([task], num_threads=1)
    engine.reset([0], [episode_seed(task, seed, 0)])
    for step in range(steps):
        engine.step(rollout["next", "executed_action"][step : step + 1].numpy(), np.ones(1, bool))
    poses, model = engine.poses(0), engine.row_model(0)
    motion = Motion(model, poses.position[None].astype(np.float32), poses.quaternion[None].astype(np.float32))
    picture = _mujocos_picture(model.model, engine._rows[0]._data)
    engine.close()
    return motion, picture


def _mujocos_picture(model: Any, data: Any) -> Any:
    model.vis.global_.fovy = FIELD_OF_VIEW
    camera, away = mujoco.MjvCamera(), TARGET - EYE
    camera.lookat[:], camera.distance = TARGET, np.linalg.norm(away)
    camera.azimuth = np.degrees(np.arctan2(away[1], away[0]))
    camera.elevation = np.degrees(np.arcsin(away[2] / camera.distance))
    with mujoco.Renderer(model, HEIGHT, WIDTH) as renderer:
        renderer.update_scene(data, camera)
        return renderer.render()


def _our_picture(client: Any, task: str, motion: Motion, folder: str) -> Any:
    file, picture = f"{folder}/scene.rrd", f"{folder}/scene.png"
    stream = rr.RecordingStream(f"scene-of-{task}")  # an application has one layout
    stream.save(file)
    stream.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    frames = log_motion(stream, "/bodies", motion, {}, STEP_TIME)
    eye = rrb.EyeControls3D(position=EYE, look_target=TARGET, eye_up=(0.0, 0.0, 1.0))
    view = rrb.Spatial3DView(
        origin="/",
        eye_controls=eye,
        line_grid=False,
        background=(90, 120, 160),
        overrides={mesh: rr.CoordinateFrame(f"tf#{body}") for mesh, body in frames.items() if body},
    )
    stream.send_blueprint(rrb.Blueprint(view, collapse_panels=True))
    stream.flush()
    stream.disconnect()
    client.close("all")
    client.open(file)
    state = _patiently(lambda: _loaded(client))
    time.sleep(3)
    _patiently(lambda: client.save_screenshot(picture, view_id=state.views[0].view_id))
    pixels = plt.imread(picture)
    height, width = pixels.shape[:2]
    beside = max(0, width - height * WIDTH // HEIGHT) // 2
    return pixels[:, beside : width - beside]


def _loaded(client: Any) -> Any:
    state = client.get_state()
    if state.loading or not state.views:
        raise TimeoutError("the viewer is loading")
    return state


def _patiently(call: Callable[[], Any], tries: int = 60) -> Any:
    """Repeat a call until it succeeds, because software rendering is slow, and return the result."""
    for _ in range(tries - 1):
        try:
            return call()
        except (TimeoutError, ConnectionError):
            time.sleep(1)
    return call()


def main(arguments: Arguments) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    command = [sys.executable, "-m", "rerun", "--headless", "--bind", "127.0.0.1", "--port", port]
    quiet = {**os.environ, "RUST_LOG": "off"}  # otherwise the viewer's messages cover the views
    viewer = subprocess.Popen(command, env=quiet, stderr=subprocess.DEVNULL, start_new_session=True)
    client = _patiently(lambda: ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy"))
    figure, axes = plt.subplots(3, 4, figsize=(12, 7.4), layout="constrained")
    with TemporaryDirectory() as folder:
        for task, pair in zip(arguments.tasks, axes.reshape(-1, 2), strict=True):
            motion, theirs = _at_success(task, arguments.seed)
            for axis, picture, whose in zip(
                pair, (_our_picture(client, task, motion, folder), theirs), ("recorded", "MuJoCo"), strict=True
            ):
                axis.imshow(picture)
                axis.set_title(f"{task}, {whose}", fontsize=9)
                axis.axis("off")
    os.killpg(viewer.pid, signal.SIGTERM)  # the viewer is a child of the module
    viewer.wait()
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(arguments.out, dpi=80)
    print(f"written to {arguments.out}")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(tyro.cli(Arguments))
