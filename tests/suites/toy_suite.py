"""A custom suite in NumPy: three blocks, no numbers of the previous step, actions of 7 numbers, of which 4 count."""

import numpy as np

import lw_torchrl as lw
from lw_torchrl.language.layout import Layout, Slot
from lw_torchrl.language.objects import GRIPPER, NamedObject
from lw_torchrl.language.skills import ScriptedSkill
from lw_torchrl.suites import Suite
from lw_torchrl.suites.engine import EngineStep

TOY = Layout(
    "toy", 16, hand=1, opening=0, things=(Slot(4), Slot(7), Slot(10)), goal=13, action_size=7, displacement=1,
    gripper=6, closes=-1, reach=0.05, binary_gripper=True,
)  # fmt: skip


def _task(name: str, block: str, at: int) -> lw.Task:
    things = (NamedObject(GRIPPER, (1, 2, 3)), NamedObject(block, (at, at + 1, at + 2)))
    return lw.Task(f"toy/{name}", f"Touch the {block}.", things, TOY)


TASKS = {task.name: task for task in (_task("touch-red", "red block", 4), _task("touch-blue", "blue block", 10))}
MOVES = {f"move the gripper to the {block}": block for block in ("red block", "blue block")}
SKILLS = {text: ScriptedSkill(text, block, gripper=1.0) for text, block in MOVES.items()}


def _plan(task: lw.Task) -> lw.ConditionalPlan:
    block = task.object_names[1]
    conditions = [f"the robot's gripper is {relation} the {block}" for relation in ("not near", "near")]
    return lw.ConditionalPlan.from_pairs(task, [(each, f"move the gripper to the {block}") for each in conditions])


class ToyEngine:
    """Rows of one hand and three blocks; an action moves the hand, and closes a gripper in two steps.

    The hand keeps a share of its speed, ``inertia``, from step to step; ``closing`` is how far the fingers go in one.
    """

    def __init__(self, row_tasks, *, reward="sparse", num_threads=None, reach=0.05, inertia=0.0, closing=0.5):
        self.target = np.array([TASKS[task].objects[1].position[0] for task in row_tasks])
        self.state = np.zeros((len(row_tasks), TOY.size))
        self.dense, self.reach, self.inertia, self.closing = reward == "dense", reach, inertia, closing
        self.speed = np.zeros((len(row_tasks), 3))

    def reset(self, rows, seeds):
        for row, seed in zip(rows, seeds, strict=True):
            drawn = np.random.default_rng(seed)
            self.state[row] = self.speed[row] = 0.0
            self.state[row, 0] = 1.0
            self.state[row, 1:4] = (0.0, 0.5, 0.2)
            self.state[row, 4:13] = drawn.uniform(-0.2, 0.2, 9)
            self.state[row, [6, 9, 12]] = 0.02
            self.state[row, 13:16] = self.state[row, 4:7] + (0.0, 0.0, 0.2)
        return self.state[list(rows)].copy()

    def step(self, action, active):
        asked = np.where(active[:, None], action.astype(float), 0.0)
        self.speed = self.inertia * self.speed + (1 - self.inertia) * self.reach * asked[:, 1:4]
        self.state[:, 1:4] += self.speed
        self.state[:, 3] = np.maximum(self.state[:, 3], 0.02)
        self.state[:, 0] = np.clip(self.state[:, 0] + self.closing * np.sign(asked[:, 6]), 0.0, 1.0)
        block = np.take_along_axis(self.state, self.target[:, None] + np.arange(3), 1)
        gap = np.linalg.norm(block - self.state[:, 1:4], axis=1)
        success = (gap < 0.03) & active
        reward = np.where(active, -gap if self.dense else success.astype(float), 0.0)
        return EngineStep(self.state.copy(), reward, success, np.zeros(len(gap), bool))

    def close(self):
        pass


def make_toy_suite(engine=ToyEngine) -> Suite:
    plans = lw.Plans([_plan(task) for task in TASKS.values()])
    return Suite("toy", TOY, TASKS, engine, skills=SKILLS, plans=plans, max_steps=30)
