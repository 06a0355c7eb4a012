"""The Fetch engine: bit-identical to gymnasium-robotics, but multithreaded and with Meta-World's axes.

In Fetch's axes, x points away from the robot, y to the left, and z up from the floor. In Meta-World's axes, x points
right, y away from the robot, and z up from the table. Both are in metres.
"""

from collections.abc import Sequence
from contextlib import redirect_stderr
from functools import cache
from importlib import import_module
from io import StringIO
from typing import Any, Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from lw_torchrl._util.checks import Count, check_choice, typed
from lw_torchrl._util.rendering import naming_absent_renderer
from lw_torchrl.suites.engine import BodyPoses, RowModel
from lw_torchrl.suites.fetch import FETCH
from lw_torchrl.suites.metaworld.compiled_rows import addresses_of
from lw_torchrl.suites.metaworld.environments import UNSTABLE, WARNED_ALREADY
from lw_torchrl.suites.metaworld.observation import Array, Index, Mask
from lw_torchrl.suites.metaworld.simulated_rows import ThreadedEngine

HAND_HEIGHT = 0.03
"""Height (metres) of the observed hand position above Fetch's grip site, which is between the finger pads. Meta-World's
hand is equally high above a held object, so relations such as "near" have the same meaning."""
OPEN = 0.1
"""Distance (metres) between the fingers of an open gripper."""


def our_positions(positions: Array, origin: Array) -> Array:
    """Convert positions (..., 3) from Fetch's to Meta-World's axes; ``origin`` (..., 3) is given in Fetch's axes."""
    offset = positions - origin
    return np.stack((-offset[..., 1], offset[..., 0], offset[..., 2]), -1)


def our_quaternions(quaternions: Array) -> Array:
    """Convert rotations (..., 4) in w, x, y, z order from Fetch's to Meta-World's axes; the identity stays the same."""
    w, x, y, z = np.moveaxis(quaternions, -1, 0)
    return np.stack((w, -y, x, z), -1)


def turned_quaternions(quaternions: Array) -> Array:
    """Convert body orientations (..., 4) in w, x, y, z order from Fetch's to Meta-World's axes."""
    w, x, y, z = np.moveaxis(quaternions, -1, 0)
    return np.sqrt(0.5) * np.stack((w - z, x - y, x + y, w + z), -1)


def fetch_actions(action: NDArray[Any]) -> NDArray[Any]:
    """Convert actions (..., 4) from Meta-World's axes, where +1 closes the gripper, to Fetch's, where +1 opens it."""
    return np.stack((action[..., 1], -action[..., 0], action[..., 2], -action[..., 3]), -1)


CAMERAS = ("external_camera_0", "head_camera_rgb", "gripper_camera_rgb", "lidar")
"""Names of the cameras in Fetch's scenes."""

_NOW = FETCH.past or 0  # number of values in an observation that describe the current time step
# Columns of the values that are read from MuJoCo's state, in Fetch's axes.
_GRIP, _FINGERS, _OBJECT, _QUATERNION = slice(0, 3), slice(3, 5), slice(5, 8), slice(8, 12)
_HAND, _HAND_QUATERNION, _DRIVEN = slice(12, 15), slice(15, 19), slice(19, 21)
_FINGER_JOINTS = ("robot0:r_gripper_finger_joint", "robot0:l_gripper_finger_joint")
_TURN = np.array([1.0, 0.0, 1.0, 0.0])  # gymnasium-robotics adds this to the hand's quaternion: fingers down
_METRES = 0.05  # metres per unit of displacement
_SUCCESS = 0.05  # maximum distance to the goal at success, metres


# Each task's module and class in gymnasium-robotics, and the origin of Meta-World's axes in Fetch's axes (metres). With
# this origin, an object on the table has z = 0.018, 2 mm below the threshold of "touching the table", and the hand
# starts near x = 0, y = 0.6.
_SCENES = {
    "fetch/reach": ("reach", "MujocoFetchReachEnv", (0.745, 0.75, 0.40675)),
    "fetch/push": ("push", "MujocoFetchPushEnv", (0.745, 0.75, 0.40675)),
    "fetch/slide": ("slide", "MujocoFetchSlideEnv", (0.395, 0.75, 0.3955)),
    "fetch/pick-and-place": ("pick_and_place", "MujocoFetchPickAndPlaceEnv", (0.745, 0.75, 0.40675)),
}


@cache
def _builder(task: str) -> Any:
    """Build a task's gymnasium-robotics environment, whose model never changes and is shared by all rows."""
    scene, env, _ = _SCENES[task]
    with naming_absent_renderer(), redirect_stderr(StringIO()):  # the import prints messages about other environments
        try:
            module = import_module(f"gymnasium_robotics.envs.fetch.{scene}")
        except ImportError as error:
            raise ImportError("the Fetch suite needs the extra [fetch]: pip install 'lw_torchrl[fetch]'") from error
    return getattr(module, env)()


class _Row:
    """A MuJoCo state on a shared model. Resets run gymnasium-robotics' code on a shallow copy of the environment."""

    def __init__(self, task: str) -> None:
        built = _builder(task)
        self._model, self._substeps = built.model, int(built.n_substeps)
        self.data = data = mujoco.MjData(self._model)
        self._env = object.__new__(type(built))
        self._env.__dict__.update(built.__dict__, data=data, mujoco_renderer=None)
        self.path = str(built.fullpath)
        self.has_object, self._blocked = bool(built.has_object), bool(built.block_gripper)
        self.goal: Array = np.zeros(3)

        hand = self._model.body("robot0:gripper_link").id
        self.bodies = BodyPoses(data.xpos, data.xquat)  # views of the current state
        self._mocap = data.mocap_pos[0], data.mocap_quat[0]
        fingers = [int(self._model.joint(name).qposadr[0]) for name in _FINGER_JOINTS]
        self._fingers = [data.qpos[finger : finger + 1] for finger in fingers]
        # The joints that actuators drive; controls are relative to the joint positions. Two tasks have no actuators.
        driven = [data.qpos[joint : joint + 1] for joint in self._model.jnt_qposadr[self._model.actuator_trnid[:, 0]]]
        self._target = self._model.site("target0").id
        none = np.zeros(_DRIVEN.stop)  # zeros for values that the task lacks
        grip = data.site_xpos[self._model.site("robot0:grip").id]
        objects = [none[_OBJECT], none[_QUATERNION]]
        driven = driven or [none[_DRIVEN]]
        if self.has_object:
            objects = [data.site_xpos[self._model.site("object0").id], data.xquat[self._model.body("object0").id]]
        self._sources = [grip, *self._fingers, *objects, data.xpos[hand], data.xquat[hand], *driven]
        self._warnings = data.warning.number[UNSTABLE]

    def reset(self, seed: int, read: Array) -> None:
        """Start an episode and fill ``read`` (21,) with the initial state."""
        self.goal = self._env.reset(seed=seed)[0]["desired_goal"]
        self.data.warning.number[:] = WARNED_ALREADY
        np.concatenate(self._sources, out=read)

    def simulate(self, inputs: Array, outputs: Array) -> bool:
        """Write the inputs (mocap position and quaternion, controls), simulate 20 physics steps, fill the outputs (21,)
        with the new state, and return whether the simulation is stable."""
        data = self.data
        self._mocap[0][:], self._mocap[1][:] = inputs[:3], inputs[3:7]
        data.ctrl[:] = inputs[7 : 7 + len(data.ctrl)]
        mujoco.mj_step(self._model, data, self._substeps)
        if self._blocked:
            for finger in self._fingers:
                finger[:] = 0.0
            mujoco.mj_forward(self._model, data)
        np.concatenate(self._sources, out=outputs)
        return bool((self._warnings == WARNED_ALREADY).all())

    def describe(self) -> dict[str, Any]:
        """Return the arguments of :class:`~lw_torchrl.suites.metaworld.compiled_rows.CompiledRows` for this row."""
        return {
            "model": self._model,
            "data": self.data._address,
            "substeps": self._substeps,
            "looks": self._blocked,
            "inputs_at": addresses_of(*self._mocap, self.data.ctrl),
            "zeros_at": addresses_of(*self._fingers) if self._blocked else [],
            "outputs_at": addresses_of(*self._sources),
            "warnings_at": addresses_of(self._warnings),
        }

    def seen(self) -> tuple[RowModel, Any]:
        """Return the model and the data. The target marker, which does not affect physics, is placed at the goal."""
        self.data.site_xpos[self._target] = self.goal
        return RowModel(self.path, self._model), self.data


class FetchEngine(ThreadedEngine):
    """An engine for FetchReach-v4, FetchPush-v4, FetchSlide-v4 and FetchPickAndPlace-v4.

    States, goals and success flags are bit-identical to those of ``gymnasium.make(id)`` after ``reset(seed=seed)`` and
    the same actions, for any number of threads. An action (right, away, up, effort) becomes gymnasium-robotics' (away,
    -right, up, -effort) of the same dtype. A displacement of 1 requests 5 cm, but the hand moves only 3.2 cm per time
    step. The gripper effort is relative to the current finger positions, so an effort of 0 does not hold the puck.
    Reach, push and slide keep the fingers closed.

    Observations (25 values, :data:`~lw_torchrl.suites.fetch.FETCH`) are in metres and in Meta-World's axes. In
    reach, the object's values are 0 and the goal is a hand position, 3 cm above the grip site's goal. Errors in a row
    are handled as in :class:`~lw_torchrl.suites.metaworld.vectorized_engine.VectorizedEngine`.

    Args:
        tasks: the task of each row.
        reward: "sparse" for 1 at success and 0 otherwise; "dense" for the negative distance to the goal in metres.
        num_threads: number of simulation threads; None for one per core.

    Source: Plappert et al., 'Multi-Goal Reinforcement Learning'; gymnasium-robotics 1.4.2.
    """

    @typed
    def __init__(
        self, tasks: Sequence[str], *, reward: Literal["sparse", "dense"] = "sparse", num_threads: Count | None = None
    ) -> None:
        self._dense = reward == "dense"
        tasks = [check_choice("task", task, _SCENES) for task in tasks]
        n = len(tasks)
        super().__init__([""] * n, FETCH, num_threads)  # models are read-only, so rows need not be grouped by model
        self._rows = [_Row(task) for task in tasks]
        self._origin = np.array([_SCENES[task][2] for task in tasks]).reshape(n, 3)
        self._has_object = np.array([row.has_object for row in self._rows], dtype=bool)
        self._read = np.zeros((n, _DRIVEN.stop))
        self._compile()

    def _reset_row(self, row: int, seed: int) -> None:
        self._rows[row].reset(seed, self._read[row])
        self._goal[row] = self._rows[row].goal

    def _observe_first(self, rows: Index) -> None:
        now = self._now(rows)
        goal = our_positions(self._goal[rows], self._origin[rows])
        goal[:, 2] += np.where(self._has_object[rows], 0.0, HAND_HEIGHT)
        self._observation[rows] = np.concatenate((now, now, goal), axis=1)

    def _step_running(self, rows: Index, action: NDArray[Any], reward: Array, success: Mask) -> None:
        action = fetch_actions(np.clip(action[rows], -1, 1))
        displacement = action[:, :3] * _METRES  # multiplied in the action's precision
        read = self._read[rows]
        inputs = (read[:, _HAND] + displacement, read[:, _HAND_QUATERNION] + _TURN, read[:, _DRIVEN] + action[:, 3:])
        stable = self._simulate(rows, np.concatenate(inputs, axis=1), read)
        self._read[rows] = read

        now = self._now(rows)
        stable &= np.isfinite(now).all(axis=1)
        self._faulted[rows[~stable]] = True
        rows, now = rows[stable], now[stable]
        achieved = np.where(self._has_object[rows, None], self._read[rows, _OBJECT], self._read[rows, _GRIP])
        distance = np.linalg.norm(achieved - self._goal[rows], axis=-1)
        success[rows] = distance < _SUCCESS
        reward[rows] = -distance if self._dense else success[rows]
        self._observation[rows, _NOW : 2 * _NOW] = self._observation[rows, :_NOW]
        self._observation[rows, :_NOW] = now

    def _now(self, rows: Index) -> Array:
        """Return the part of the observations for the current time step: the first 11 values (len(rows), 11)."""
        read, origin = self._read[rows], self._origin[rows]
        now = np.zeros((len(rows), _NOW))
        now[:, :3] = our_positions(read[:, _GRIP], origin)
        now[:, 2] += HAND_HEIGHT
        now[:, 3] = np.clip((read[:, 3] + read[:, 4]) / OPEN, 0.0, 1.0)
        objects = self._has_object[rows]
        now[objects, 4:7] = our_positions(read[objects, _OBJECT], origin[objects])
        now[objects, 7:] = our_quaternions(read[objects, _QUATERNION])
        return now

    def poses(self, row: int) -> BodyPoses:
        """Return the current poses of all bodies of a row, in Meta-World's axes."""
        position, quaternion = super().poses(row)
        return BodyPoses(our_positions(position, self._origin[row]), turned_quaternions(quaternion))

    def render(self, rows: Sequence[int], *, camera: str, height: int, width: int) -> NDArray[np.uint8]:
        """Render images as :meth:`SeenRows.render` does, with one of Fetch's cameras."""
        return super().render(rows, camera=check_choice("camera", camera, CAMERAS), height=height, width=width)
