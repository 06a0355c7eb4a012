"""A custom suite: run Meta-World policies on robosuite's Lift, Stack and Door, with any arm and a Panda gripper.
python examples/suite_robosuite.py check --arms Panda Sawyer                 # compare the simulator with the layout
python examples/suite_robosuite.py expert --arms Panda --task stack --seed 7 # scripted skills
python examples/suite_robosuite.py POLICY --arms Panda Sawyer --task lift --episodes 50 --seed 3000

POLICY is a file from `python -m benchmarks.paper zero-shot --methods pcbc`, trained on Meta-World only. Tasks and plans
are in robosuite_words/. pip install 'lw_torchrl[robosuite]'; with mujoco 3.3, the arm Sawyer needs robosuite 1.5.2.
"""

import argparse
import logging
import tomllib
from pathlib import Path

import numpy as np

import lw_torchrl as lw
from lw_torchrl.language.canonical import canonical_like
from lw_torchrl.language.layout import Layout, Slot
from lw_torchrl.suites import Suite, check_suite
from lw_torchrl.suites.engine import EngineStep, checked_step, seeds_of_rows

logging.getLogger("robosuite_logs").disabled = True  # robosuite logs every controller that it loads
import robosuite  # noqa: E402

HAND, TIPS = 0.035, 0.009  # metres: hand above robosuite's grip site (as in Meta-World); fingertips below the site
TABLE, RESTING = 0.8, 0.0194  # metres: z of the table in robosuite; z of a resting cube here, as of Meta-World's puck
NOW = 10  # size of the current part of an observation: hand (3), opening, two objects (3, 3); past part and goal follow
LAYOUT = Layout(  # only the sign of the gripper effort matters; within 3 cm, the fingertips are on both sides of a cube
    "robosuite", 23, hand=0, opening=3, things=(Slot(4), Slot(7)), goal=20, past=NOW, reach=0.01, binary_gripper=True,
    thresholds={"near": 0.03},
)  # fmt: skip
WORDS = Path(__file__).parent / "robosuite_words"
ROWS = tomllib.loads((WORDS / "tasks.toml").read_text("utf-8"))
TASKS = {name: lw.Task.from_json(name, row, LAYOUT) for name, row in ROWS.items()}
THINGS = {"lift": ["cube_pos"], "stack": ["cubeA_pos", "cubeB_pos"], "door": ["handle_pos"]}
GOAL = {"lift": (0.0, 0.2, 0.155), "stack": (0.0, 0.0, 0.045), "door": (-0.1, 0.0, 0.0)}  # metres, from THINGS[-1]


class Row:
    """A robosuite environment with observations in our axes: x right, y away from the robot, z up from the table."""

    def __init__(self, task: str, arm: str) -> None:
        self.task, self.things = task, THINGS[task]
        config = robosuite.load_composite_controller_config(controller="BASIC", robot=arm)
        part = {"type": "OSC_POSITION", "input_ref_frame": "world", "output_max": [1.0] * 3, "output_min": [-1.0] * 3}
        # Twice robosuite's stiffness keeps slow arms on course. With this damping, the hand lags by three steps.
        config["body_parts"] = {"right": config["body_parts"]["right"] | part | {"kp": 300, "damping_ratio": 2**0.5}}
        options = {"has_renderer": False, "has_offscreen_renderer": False, "use_camera_obs": False, "ignore_done": True}
        options |= {"robots": arm, "gripper_types": "PandaGripper", "controller_configs": config}
        self.env = robosuite.make(task.title(), **options, **({"use_latch": False} if task == "door" else {}))

    def reset(self, seed: int) -> np.ndarray:
        before = np.random.get_state()  # noqa: NPY002
        np.random.seed(seed % 2**32)  # noqa: NPY002  robosuite 1.5.1 draws from this generator, 1.5.2 from its own
        self.env.rng = self.env.placement_initializer.rng = np.random.default_rng(seed)
        self.env.reset()
        np.random.set_state(before)  # noqa: NPY002
        robot, qpos = self.env.robots[0], self.env.sim.data.qpos
        self.arm = robot.part_controllers["right"]
        if self.task == "door":  # turn the wrist, so that the palm fits between the handle and the door
            qpos[(joints := robot._ref_joint_pos_indexes)[-1]] += np.pi / 2
            self.env.sim.forward()
            self.arm.update_initial_joints(qpos[joints])
        self.arm.set_goal_update_mode("desired")  # displacements accumulate, as in Meta-World
        self.origin = np.array([robot.base_pos[0], 0.0, TABLE])
        for _ in range(20):  # let the fingers open and the objects come to rest
            seen = self._simulate((0.0, 0.0, 0.0, -1.0))
        self.origin[2] = TABLE if self.task == "door" else seen[self.things[0]][2] - RESTING
        now = self._now(seen)
        self.seen = np.concatenate((now, now, now[: 4 + 3 * len(self.things)][-3:] + GOAL[self.task]))
        return self.seen

    def step(self, action: np.ndarray) -> np.ndarray:
        self.seen = np.concatenate((self._now(self._simulate(action)), self.seen[:NOW], self.seen[2 * NOW :]))
        return self.seen

    def _simulate(self, action):
        right, away, up, effort = map(float, action)
        way = LAYOUT.reach * np.array([away, -right, up])
        way[2] = max(way[2], TABLE + TIPS - self.arm.goal_pos[2])
        return self.env.step(np.array([*way, effort]))[0]

    def _now(self, seen):
        found = np.zeros(NOW)
        for at, name in zip((0, 4, 7), ("robot0_eef_pos", *self.things), strict=False):
            away, left, up = seen[name] - self.origin
            found[at : at + 3] = -left, away, up + (0.0 if at else HAND)
        found[3] = np.clip(np.abs(seen["robot0_gripper_qpos"]).sum() / 0.08, 0.0, 1.0)
        return found


class Engine:
    """An engine that steps one robosuite environment per row, one after another."""

    def __init__(self, row_tasks, arm, *, reward="sparse", num_threads=None):
        self.rows = [Row(task.partition("/")[2], arm) for task in row_tasks]
        n, self.dense = len(self.rows), reward == "dense"
        self.seen, self.started, self.faulted = np.zeros((n, LAYOUT.size)), np.zeros(n, bool), np.zeros(n, bool)

    def reset(self, rows, seeds):
        index, seed_of = seeds_of_rows(rows, seeds)
        self.seen[index] = [self.rows[row].reset(seed_of[row]) for row in index]
        self.started[index], self.faulted[index] = True, False
        return self.seen[index]

    def step(self, action, active):
        action, active = checked_step(action, active, self.started, LAYOUT.action_size)
        reward, success = np.zeros(len(active)), np.zeros(len(active), bool)
        self.faulted |= active & ~np.isfinite(action).all(1)
        for row in np.flatnonzero(active & ~self.faulted):
            self.seen[row] = self.rows[row].step(np.clip(action[row], -1, 1))
            success[row] = self.rows[row].env._check_success()
            reward[row] = self.rows[row].env.reward(None) if self.dense else success[row]
        return EngineStep(self.seen.copy(), reward, success, active & self.faulted)

    def close(self):
        self.rows = []


def make_suite(arm: str = "Panda") -> Suite:
    """Return the suite for one of robosuite's arms with a Panda gripper."""
    how = dict(plans=lw.load_plans(WORDS, tasks=TASKS), skills=lw.load_skills(WORDS / "skills.toml", tasks=TASKS))
    engine = lambda rows, **options: Engine(rows, arm, **options)  # noqa: E731
    return Suite("robosuite", LAYOUT, TASKS, engine, max_steps=300, step_time=0.05, **how)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy", help="policy file, or expert for scripted skills, or check to verify the suite")
    parser.add_argument("--arms", nargs="+", default=["Panda"], help="robosuite's names of the arms")
    parser.add_argument("--task", choices=THINGS, default="lift")
    for name, number in (("episodes", 50), ("seed", 3000), ("steps", 300), ("rows", 5)):
        parser.add_argument(f"--{name}", type=int, default=number, help=f"default: {number}")
    args = parser.parse_args()
    for arm, suite in ((arm, make_suite(arm)) for arm in args.arms):
        if args.policy == "check":
            print(*(f"{arm} {one}" for one in check_suite(suite)), sep="\n")
            continue
        actor = lw.ScriptedSkillActor(suite.plans, skills=suite.skills)
        if args.policy != "expert":
            trained = lw.load_actor(args.policy)
            actor = lw.modules.TransferredActor(trained, canonical_like(suite.plans, lw.modules.plans_of(trained)))
        result = lw.evaluate(
            actor, tasks=f"robosuite/{args.task}", suite=suite, episodes_per_task=args.episodes, seed=args.seed,
            max_steps=args.steps, num_envs=args.rows, noise_scale=0.0, stop_at_success=True,
        )  # fmt: skip
        print(f"{arm} {args.task}: {result.mean_success:.2f}", flush=True)


if __name__ == "__main__":
    main()
