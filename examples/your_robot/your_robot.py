"""A custom robot: an arm with two joints and three blocks, from arm.xml to a trained policy and a recording.

python your_robot.py                  # about a minute on one core
python your_robot.py --steps 20       # a quick test
"""

import argparse
from pathlib import Path

import mujoco
import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase

import lw_torchrl as lw
from lw_torchrl.language.layout import Layout, Slot
from lw_torchrl.language.objects import GRIPPER, NamedObject
from lw_torchrl.modules import Concat, ObservationFeatures, RoleFeatures
from lw_torchrl.record.rollouts import run_recorded
from lw_torchrl.suites import SUITES, Suite, check_suite
from lw_torchrl.suites.cameras import SeenRows
from lw_torchrl.suites.engine import EngineStep, RowModel, checked_step, seeds_of_rows

XML = Path(__file__).with_name("arm.xml")
COLORS = ("red", "green", "blue")
BASE = (0.0, 0.4)  # position of the shoulder, in view of the camera of recordings
SUBSTEPS = 10  # simulation steps of 0.005 s per action
SPEED = 2.0  # radians per second at an action of 1

# 1. The layout: the meaning of each number in observations and actions. Metres: x right, y away from the robot, z up.
ARM = Layout(
    "arm",
    size=18,
    hand=0,  # numbers 0, 1, 2 are the hand's position
    opening=3,  # always 1, because this robot has no gripper
    things=(Slot(4), Slot(7), Slot(10)),  # the three blocks
    goal=13,  # the remaining numbers, 16 and 17, are the joint angles
    action_size=2,
    displacement=None,  # actions turn joints, so no number of an action moves the hand along an axis
    gripper=None,
)

# 2. The tasks: descriptions, and the objects that conditions may name.
OBJECTS = (
    NamedObject(GRIPPER, (0, 1, 2)),
    *(NamedObject(f"{color} block", (4 + 3 * n, 5 + 3 * n, 6 + 3 * n)) for n, color in enumerate(COLORS)),
)
TASKS = {
    f"arm/touch-{color}": lw.Task(f"arm/touch-{color}", f"Touch the {color} block.", OBJECTS, ARM) for color in COLORS
}


# 3. The engine: a simulator with one row for each name in row_tasks.
class ArmEngine(SeenRows):
    def __init__(self, row_tasks, *, reward, num_threads):
        self.simulator = mujoco.MjModel.from_xml_path(str(XML))
        self.data = [mujoco.MjData(self.simulator) for _ in row_tasks]
        self.targets = [COLORS.index(task.removeprefix("arm/touch-")) for task in row_tasks]
        self.states = np.zeros((len(row_tasks), ARM.size))
        self.started = np.zeros(len(row_tasks), bool)

    def reset(self, rows, seeds):  # only the task and the seed determine the episode
        index, seed_of = seeds_of_rows(rows, seeds)
        for row in index:
            random, data = np.random.default_rng(seed_of[row]), self.data[row]
            mujoco.mj_resetData(self.simulator, data)
            data.qpos[:] = random.uniform([0.6, 0.8], [1.2, 1.6])
            angle = np.radians([50, 90, 130]) + random.uniform(-0.2, 0.2, 3)
            radius = random.uniform(0.25, 0.4, 3)
            data.mocap_pos[:, :2] = BASE + np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)
            mujoco.mj_forward(self.simulator, data)
            self.started[row] = True
            self.observe(row)
        return self.states[index].copy()

    def step(self, action, active):
        action, active = checked_step(action, active, self.started, ARM.action_size)
        distance = np.ones(len(active))
        for row in np.flatnonzero(active):
            self.data[row].ctrl[:] = SPEED * action[row]
            mujoco.mj_step(self.simulator, self.data[row], SUBSTEPS)
            mujoco.mj_forward(self.simulator, self.data[row])
            self.observe(row)
            distance[row] = np.linalg.norm(self.states[row, :2] - self.states[row, 13:15])
        success = active & (distance < 0.03)
        return EngineStep(self.states.copy(), success.astype(float), success, np.zeros(len(active), bool))

    def observe(self, row):
        data = self.data[row]
        hand, blocks = data.site("hand").xpos, data.mocap_pos
        self.states[row] = np.hstack((hand, 1.0, blocks.ravel(), blocks[self.targets[row]], data.qpos))

    def _seen(self, row):  # the model and state for recordings and camera images
        return RowModel(str(XML), self.simulator), self.data[row]

    def close(self):
        pass


# 4. Plans, and a demonstrator. A robot whose actions move the hand can have scripted skills instead.
PLANS = lw.Plans(
    lw.ConditionalPlan.from_pairs(
        task,
        [
            (f"the gripper is not near the {color} block", f"move the gripper to the {color} block"),
            (f"the gripper is near the {color} block", f"hold the gripper at the {color} block"),
        ],
    )
    for color, task in zip(COLORS, TASKS.values(), strict=True)
)


class Expert(TensorDictModuleBase):
    """A demonstrator that moves the hand to the goal with the damped pseudo-inverse of the Jacobian."""

    layout, tasks = ARM, tuple(TASKS)
    in_keys, out_keys = ("observation",), ("action", "unclipped_action")

    def forward(self, tensordict):
        state = tensordict["observation"].double()
        hand, goal, shoulder, elbow = state[:, :2], state[:, 13:15], state[:, 16], state[:, 16] + state[:, 17]
        forearm = 0.25 * torch.stack((-elbow.sin(), elbow.cos()), -1)
        upper_arm = 0.25 * torch.stack((-shoulder.sin(), shoulder.cos()), -1)
        jacobian = torch.stack((upper_arm + forearm, forearm), -1)
        damped = jacobian @ jacobian.mT + 1e-3 * torch.eye(2).double()
        speed = jacobian.mT @ torch.linalg.solve(damped, 3.0 * (goal - hand)[..., None])
        action = (speed[..., 0] / SPEED).float()
        return tensordict.update({"action": action.clamp(-1.0, 1.0), "unclipped_action": action})


SUITES["arm"] = Suite(
    name="arm",
    layout=ARM,
    tasks=TASKS,
    make_engine=ArmEngine,
    plans=PLANS,
    make_expert=lambda tasks: Expert(),
    max_steps=80,
    step_time=SUBSTEPS * 0.005,
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--episodes", type=int, default=10, help="number of demonstrations per task")
    parser.add_argument("--out", type=Path, default=Path("runs/arm"))
    args = parser.parse_args()

    for finding in check_suite(SUITES["arm"]):
        assert finding.right is not False, finding

    # 5. Collect demonstrations, train, evaluate and record.
    demos = args.out / "demos"
    lw.collect_demonstrations("arm", episodes_per_task=args.episodes, noise_scale=[0.0, 0.2], root=demos, seed=0)
    plans = lw.canonical_plans(PLANS)  # steps become verbs, objects and targets, so no text encoder is needed
    features = Concat(ObservationFeatures("raw", noise=0.02, layout=ARM), RoleFeatures(plans, noise=0.02))
    actor = lw.PlanConditionedActor(plans, features=features)
    sampler, transform = lw.TaskBalancedSampler(), lw.QAFTransform(plans)
    replay = lw.LanguageWorldExperienceReplay(demos, sampler=sampler, transform=transform, after_success=10)
    config = lw.BehavioralCloningConfig(steps=args.steps, batch_size=150)
    policy = args.out / "policy.safetensors"
    lw.BehavioralCloningTrainer(actor, replay, config, checkpoint=policy).train()
    result = lw.evaluate(actor, tasks="arm", episodes_per_task=20, seed=1_000, stop_at_success=True)
    print(result.table())

    (episode,) = run_recorded(actor, "arm/touch-red", seed=1_000)
    with lw.RerunLogger(args.out / "arm.rrd") as logger:
        lw.log_rollout(logger, episode.steps, plans, seed=1_000)
    print(f"lw-torchrl view {args.out / 'arm.rrd'}")


if __name__ == "__main__":
    main()
