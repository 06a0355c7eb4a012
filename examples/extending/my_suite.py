"""A custom suite: a desk, a puck and a hand that follows actions exactly. Replace DeskEngine by your own simulator.

lw-torchrl check my_suite:desk
lw-torchrl collect desk --episodes 4 --out demos --import my_suite
lw-torchrl train demos --out policy.safetensors --steps 300 --import my_suite
lw-torchrl evaluate policy.safetensors --tasks desk --episodes 2 --import my_suite
"""

import numpy as np

import lw_torchrl as lw
from lw_torchrl.language.layout import Layout, Slot
from lw_torchrl.language.objects import GRIPPER, NamedObject
from lw_torchrl.language.skills import ScriptedSkill
from lw_torchrl.suites import SUITES, Suite
from lw_torchrl.suites.engine import EngineStep

# The meaning of each number in an observation and in an action. In metres: x right, y away from the robot, z up.
DESK = Layout(
    "desk",
    size=10,
    hand=0,  # the hand's x, y, z are numbers 0, 1, 2
    opening=3,  # the gripper's opening, from 0 (closed) to 1 (open)
    things=(Slot(4),),  # the index of each object's x, which y and z follow
    goal=7,
    action_size=4,
    displacement=0,  # numbers 0, 1, 2 of an action move the hand
    reach=0.02,  # metres that the hand moves per time step at a displacement of 1
    gripper=3,  # the number of an action that moves the gripper
    closes=1,  # positive values close the gripper
)
things = (NamedObject(GRIPPER, (0, 1, 2)), NamedObject("puck", (4, 5, 6)), NamedObject("target location", (7, 8, 9)))
task = lw.Task("desk/hover", "Move the gripper above the puck.", things, DESK)


class DeskEngine:
    """A simulator with one row for each name in ``row_tasks``; the seed determines an episode."""

    def __init__(self, row_tasks, *, reward, num_threads):  # reward is "sparse" or "dense"
        self.state = np.zeros((len(row_tasks), DESK.size))

    def reset(self, rows, seeds):  # returns the observations of the rows that are reset
        for row, seed in zip(rows, seeds, strict=True):
            self.state[row] = 0.0
            self.state[row, [2, 3]] = 0.2, 1.0
            self.state[row, 4:6] = np.random.default_rng(seed).uniform(-0.2, 0.2, 2)
        return self.state[rows].copy()

    def step(self, action, active):  # returns all rows; inactive rows repeat their last observation
        move = np.where(active[:, None], action, 0.0)
        self.state[:, :3] += DESK.reach * move[:, :3]
        self.state[:, 3] = np.clip(self.state[:, 3] - 0.2 * move[:, 3], 0.0, 1.0)
        away = np.linalg.norm(self.state[:, :2] - self.state[:, 4:6], axis=1)
        success = (away < 0.02) & active
        return EngineStep(self.state.copy(), success.astype(float), success, np.zeros(len(success), bool))

    def close(self):
        pass


# Optional: plans with scripted skills, which can demonstrate the tasks.
skill = ScriptedSkill("place the gripper above the puck", "puck", offset=(0.0, 0.0, 0.1))
conditions = ["the gripper is not above the puck", "the gripper is above the puck"]
plan = lw.ConditionalPlan.from_pairs(task, [(condition, skill.text) for condition in conditions])
desk = Suite(
    name="desk",
    layout=DESK,
    tasks={task.name: task},
    make_engine=DeskEngine,
    skills={skill.text: skill},
    plans=lw.Plans([plan]),
    max_steps=60,
)
SUITES["desk"] = desk
