"""A custom suite of another size: gymnasium-robotics' FrankaKitchen, whose nine actions move joints."""

from functools import cache

import mujoco
import numpy as np
import torch
from gymnasium_robotics.envs.franka_kitchen.kitchen_env import OBS_ELEMENT_GOALS, OBS_ELEMENT_INDICES, KitchenEnv
from tensordict.nn import TensorDictModuleBase

import lw_torchrl as lw
from lw_torchrl.language.layout import Layout, Slot
from lw_torchrl.language.objects import GRIPPER, NamedObject
from lw_torchrl.suites import Suite
from lw_torchrl.suites.cameras import SeenRows
from lw_torchrl.suites.engine import BodyPoses, EngineStep, RowModel, checked_step

COUNTER = np.array([0.0, 0.0, 1.605])  # metres: the kitchen's axes are ours, but its z begins at the floor
JOINTED = ("bottom burner", "top burner", "light switch", "slide cabinet", "hinge cabinet", "microwave")
SITES = ("knob2_site", "knob4_site", "light_site", "slide_site", "hinge_site2", "microhandle_site", "kettle_site")
JOINTS = [OBS_ELEMENT_INDICES[thing][np.abs(OBS_ELEMENT_GOALS[thing]).argmax()] for thing in JOINTED]
OPEN = np.array([max(OBS_ELEMENT_GOALS[thing], key=abs) for thing in JOINTED])  # radians, or metres
# The kitchen's own 59 numbers; hand and fingers; where seven things are; how far six of them are open; the goal.
KITCHEN = Layout(
    "kitchen", size=93, hand=59, opening=62, things=tuple(Slot(63 + 3 * n) for n in range(7)), goal=90,
    action_size=9, displacement=None, gripper=None,
)  # fmt: skip
_AT = [(63 + 3 * n, 64 + 3 * n, 65 + 3 * n) for n in range(7)]
OBJECTS = (
    NamedObject(GRIPPER, (59, 60, 61)),
    *(NamedObject(thing, _AT[n], opening=84 + n) for n, thing in enumerate(JOINTED)),
    NamedObject("kettle", _AT[6]),
)
CABINET = lw.Task("kitchen/slide-cabinet", "Slide the cabinet open, to the right.", OBJECTS, KITCHEN)
MICROWAVE = lw.Task("kitchen/microwave", "Open the microwave by its handle.", OBJECTS, KITCHEN)
PLANS = lw.Plans(
    lw.ConditionalPlan.from_pairs(task, pairs)
    for task, pairs in {
        CABINET: [
            ("the slide cabinet is not open", "push the handle of the slide cabinet to the right"),
            ("the slide cabinet is open", "stay where you are"),
        ],
        MICROWAVE: [
            ("the gripper is not near the microwave and the microwave is closed", "reach for the microwave"),
            ("the gripper is near the microwave and the microwave is closed", "pull the microwave open"),
            ("the microwave is open", "stay where you are"),
        ],
    }.items()
)


@cache
def built() -> KitchenEnv:
    return KitchenEnv(remove_task_when_completed=False)


class KitchenEngine(SeenRows):
    """Rows of FrankaKitchen-v1, each with its task and state; they share the compiled model."""

    def __init__(self, row_tasks, *, reward="sparse", num_threads=None):
        self._rows = []
        for task in row_tasks:
            env, arm = object.__new__(KitchenEnv), object.__new__(type(built().robot_env))
            data, thing = mujoco.MjData(built().model), task.removeprefix("kitchen/").replace("-", " ")
            arm.__dict__.update(built().robot_env.__dict__, data=data)
            goal = {thing: OBS_ELEMENT_GOALS[thing]}
            env.__dict__.update(built().__dict__, robot_env=arm, data=data, goal=goal, tasks_to_complete={thing})
            self._rows.append(env)
        self._goals = np.array([goal_of(env) for env in self._rows])
        self._seen_last, self._started = np.zeros((len(row_tasks), KITCHEN.size)), np.zeros(len(row_tasks), bool)

    def reset(self, rows, seeds):
        for row, seed in zip(rows, seeds, strict=True):
            self._observe(row, self._rows[row].reset(seed=seed)[0])
            self._started[row] = True
        return self._seen_last[list(rows)].copy()

    def step(self, action, active):
        action, active = checked_step(action, active, self._started, KITCHEN.action_size)
        done = np.zeros(len(active))
        for row in np.flatnonzero(active):
            state, done[row], *_ = self._rows[row].step(action[row])
            self._observe(row, state)
        return EngineStep(self._seen_last.copy(), done, done > 0, np.zeros(len(active), bool))

    def _observe(self, row, state):
        data = self._rows[row].data
        fingers, things = (
            np.clip(data.qpos[7:9].sum() / 0.08, 0.0, 1.0),
            [data.site(name).xpos - COUNTER for name in SITES],
        )
        shares = np.clip(data.qpos[JOINTS] / OPEN, 0.0, 1.0)
        hand = data.site("end_effector").xpos - COUNTER
        self._seen_last[row] = np.hstack((state["observation"], hand, fingers, *things, shares, self._goals[row]))

    def _seen(self, row):
        env = self._rows[row]
        return RowModel(env.robot_env.fullpath, env.model), env.data

    def poses(self, row):
        found = super().poses(row)
        return BodyPoses(found.position - COUNTER, found.quaternion)


def goal_of(env: KitchenEnv) -> np.ndarray:
    """Return the position of the task's object when its joint is at the goal."""
    data, ((thing, goal),) = mujoco.MjData(env.model), env.goal.items()
    data.qpos[:] = env.robot_env.init_qpos
    data.qpos[OBS_ELEMENT_INDICES[thing]] = goal
    mujoco.mj_kinematics(env.model, data)
    return data.site(SITES[(*JOINTED, "kettle").index(thing)]).xpos - COUNTER


class Pusher(TensorDictModuleBase):
    """Slides the cabinet open: the hand moves beside the handle, then right, by the arm's Jacobian."""

    row_by_row = True
    in_keys, out_keys = ("observation",), ("action",)
    layout, tasks = KITCHEN, (CABINET.name, MICROWAVE.name)

    def forward(self, tensordict):
        states = tensordict["observation"].double().numpy()
        action = np.array([self.velocities(state) for state in states], np.float32)
        return tensordict.set("action", torch.from_numpy(action))

    def velocities(self, state: np.ndarray) -> np.ndarray:
        env, jacobian = built(), np.zeros((3, built().model.nv))
        env.data.qpos[:9] = state[:9]
        mujoco.mj_kinematics(env.model, env.data)
        mujoco.mj_comPos(env.model, env.data)
        mujoco.mj_jacSite(env.model, env.data, jacobian, None, env.model.site("end_effector").id)
        x, y, z = gap = state[59:62] - state[72:75]  # from the cabinet's handle to the hand
        if y > -0.06:  # as deep as the handle
            way = np.array([0.2, 0.0, 0.0])
        else:
            beside = x < -0.08 and abs(z) < 0.08
            way = np.array([-0.15, 0.0 if beside else -0.15, 0.0]) - gap
        arm, speed = jacobian[:, :7], np.clip(6.0 * way, -0.8, 0.8)  # metres a second
        turn = (
            arm.T @ np.linalg.solve(arm @ arm.T + 1e-3 * np.eye(3), speed) / 2
        )  # an action of 1 is 2 radians a second
        return np.clip(np.hstack((turn, -1.0, -1.0)), -1.0, 1.0)


def make_suite() -> Suite:
    tasks = {task.name: task for task in (CABINET, MICROWAVE)}
    return Suite("kitchen", KITCHEN, tasks, KitchenEngine, plans=PLANS, max_steps=160, step_time=0.08)
