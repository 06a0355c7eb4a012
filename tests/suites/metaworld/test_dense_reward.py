"""The dense reward of all rows at once against Meta-World's own, bit for bit."""

import warnings
from collections import defaultdict

import numpy as np
import pytest
from metaworld.policies import ENV_POLICY_MAP
from metaworld.utils import reward_utils

from lw_torchrl.suites.metaworld import observation as at
from lw_torchrl.suites.metaworld import reward_terms as terms
from lw_torchrl.suites.metaworld.dense_reward import FORMULAS, LIFTS, DenseReward
from lw_torchrl.suites.metaworld.environments import MetaWorldEngine
from lw_torchrl.suites.metaworld.observation import Observer, StateView
from lw_torchrl.suites.metaworld.simulated_rows import SimulatedRow
from lw_torchrl.suites.metaworld.tables import reward_table, simulation_table
from lw_torchrl.suites.metaworld.vectorized_engine import VectorizedEngine

TASKS = list(simulation_table())

EDGES = [0.005, 0.01, 0.015, 0.02, 0.025, 0.03, 0.035, 0.04, 0.05, 0.06, 0.065, 0.07, 0.08, 0.1, 0.12]  # metres
"""Distances at which Meta-World's formulas change."""


def play_both(tasks: list[str], steps: int, precisions: list[tuple[type, ...]], seed: int) -> dict[str, float]:
    """Return the largest difference of each task's rewards over episodes of noisy experts, with random actions and
    grips among them. ``precisions`` has an entry for each episode: the dtypes of its actions, in turn."""
    n, rng = len(tasks), np.random.default_rng(seed)
    oracle, engine = MetaWorldEngine(tasks, reward="dense"), VectorizedEngine(tasks, reward="dense", num_threads=1)
    policies = [ENV_POLICY_MAP[f"{task}-v3"]() for task in tasks]
    everyone = np.ones(n, bool)
    worst = np.zeros(n)
    for in_turn in precisions:
        seeds = rng.integers(2**31, size=n).tolist()
        seen = oracle.reset(range(n), seeds)
        engine.reset(range(n), seeds)
        for step in range(steps):
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", message="Constant.* may be too high")
                action = np.stack([policy.get_action(row) for policy, row in zip(policies, seen, strict=True)])
            action += 0.2 * rng.random((n, 1)) * rng.normal(size=(n, 4))
            wild, grips = rng.random(n) < 0.15, rng.random(n) < 0.2
            action[wild] = rng.uniform(-1, 1, (wild.sum(), 4))
            action[grips, 3] = rng.uniform(0, 1, grips.sum())
            action = np.clip(action, -1, 1).astype(in_turn[step % len(in_turn)])
            expected, got = oracle.step(action, everyone), engine.step(action, everyone)
            assert np.array_equal(expected.observation, got.observation)
            worst = np.maximum(worst, np.abs(expected.reward - got.reward))
            seen = expected.observation
    oracle.close()
    engine.close()
    return dict(zip(tasks, worst.tolist(), strict=True))


def test_rewards_of_all_tasks_have_metaworlds_bits():
    differences = play_both(TASKS, 30, [(np.float32, np.float64)], seed=0)
    assert set(differences.values()) == {0.0}, differences


@pytest.mark.slow
@pytest.mark.parametrize("tasks", [TASKS[k : k + 10] for k in range(0, 50, 10)], ids=lambda tasks: tasks[0])
def test_rewards_of_whole_episodes_have_metaworlds_bits(tasks):
    differences = play_both(tasks, 500, [(np.float32,), (np.float64,), (np.float32,)], seed=1)
    assert set(differences.values()) == {0.0}, differences


def read(row: SimulatedRow) -> np.ndarray:
    row.read_sensors(sensors := np.zeros(len(row._sensor_index)))
    return sensors


INVENTED = [at.OBJECT, at.SECOND, at.PLACE, at.HAND, at.RIGHT_TIP, at.LEFT_TIP, at.RIGHT_PAD, at.LEFT_PAD]
INVENTED += [at.RIGHT_CLAW, at.LEFT_CLAW, at.JOINT, at.QUATERNION]


def invented_numbers(row: SimulatedRow) -> list[np.ndarray | None]:
    """Return the indices of the numbers to invent; None if the task lacks the sensor, or the sensor is constant."""
    view = StateView(row._model, row._data)
    world = [*view.find("body world"), *view.find("quaternion of body world")]
    indices = [row._sensor_index[columns] for columns in INVENTED]
    return [None if np.isin(index, world).any() else index for index in indices]


def construct_states(
    engine: VectorizedEngine, numbers: list[list[np.ndarray | None]], rng: np.random.Generator
) -> np.ndarray:
    """Put the hand, objects and joints of every row where formulas change: at, near and far from the object, the start,
    the goal and other points. Return actions."""
    for number, row in enumerate(engine._rows):
        goal, starts = engine._goal[number], engine._starts.points[number]
        start, tips_start = starts[:3], starts[3:6]

        def beside(point: np.ndarray, x: float, y: float, z: float) -> np.ndarray:
            return point + np.array([x, y, z])

        def near(point: np.ndarray) -> np.ndarray:
            if rng.random() < 0.5:
                return point + rng.choice([0.0, 1e-3, 0.01, 0.05]) * rng.normal(size=3)
            direction = np.eye(3)[rng.integers(3)] * rng.choice([-1, 1])
            return point + rng.choice(EDGES) * rng.choice([0.995, 1.005]) * direction

        sensors = read(row)
        between = start + rng.random() * (goal - start)
        before = [beside(goal, 0, 0.05, -0.1), beside(goal, -0.16, -0.06, 0)][rng.integers(2)]
        thing = near([start, goal, between, before][rng.integers(4)])
        if rng.random() < 0.5:
            thing[2] = start[2] + rng.choice([0.01, 0.015, 0.02, 0.05]) * rng.choice([0.99, 1.01])
        tips = near([thing, thing, beside(thing, 0, 0, 0.03), tips_start][rng.integers(4)])
        second = near([goal, thing, start][rng.integers(3)])
        corners = sensors[at.CORNERS].reshape(-1, 3)
        place = [goal, second, second, thing][rng.integers(4)]
        if engine._starts.rewards[number].corners and rng.random() < 0.5:
            place = rng.uniform(corners.min(axis=0), corners.max(axis=0))
        pads = rng.choice([0.02, 0.03, 0.08]) * rng.random(2)
        opening = rng.choice([0.0, 0.033, 0.043, 0.05, 0.055]) * rng.choice([0.995, 1.005])
        opening = rng.choice([opening, rng.uniform(0, 0.12)])
        ideal = [[0.707, 0, 0, 0.707], [1, 0, 0, 0]][rng.integers(2)]
        invented = [
            thing - row.sources.offset,
            second - row.sources.second_offset,
            near(place),
            near(beside(tips, 0, 0, 0.04)),
            beside(tips, 0, -0.02, 0),
            beside(tips, 0, 0.02, 0),
            beside(tips, 0, -pads[0], 0),
            beside(tips, 0, pads[1], 0),
            beside(tips, 0, opening, 0),
            tips,
            rng.choice([0.1, rng.uniform(-0.1, 0.1), rng.uniform(-2, 1.6)]),
            ideal + rng.choice([0.0, 0.01, 0.2]) * rng.normal(size=4),
        ]
        for index, value in zip(numbers[number], invented, strict=True):
            if index is not None:
                row._numbers[index] = value
    n = len(engine._rows)
    action = rng.uniform(-1, 1, (n, 4))
    action[:, 3] = np.where(rng.random(n) < 0.3, rng.choice([-1.0, 0.0, 1.0], n), np.abs(action[:, 3]))
    return action


def test_formulas_have_metaworlds_bits_in_constructed_states():
    """Positions are written into the states without physics, so that rare branches are often taken."""
    n, rng = len(TASKS), np.random.default_rng(0)
    engine = VectorizedEngine(TASKS, reward="dense", num_threads=1)
    engine.reset(range(n), range(n))
    observer = Observer([row.sources for row in engine._rows])
    rewards = DenseReward(engine._starts, np.arange(n))
    compared, full, wrong = np.zeros(n, int), np.zeros(n, int), defaultdict(list)
    seen_rewards = [set() for _ in TASKS]
    numbers = [invented_numbers(row) for row in engine._rows]
    for trial in range(200):
        action = construct_states(engine, numbers, rng).astype([np.float32, np.float64][trial % 2])
        sensors = np.stack([read(row) for row in engine._rows])
        current = observer.observe(sensors)
        observation = np.concatenate((current, current, engine._goal), axis=1)
        np.clip(observation, engine._low, engine._high, out=observation)
        got = rewards(sensors, observation, engine._goal, action)
        for number, row in enumerate(engine._rows):
            try:
                expected = float(row.program.compute_reward(action[number], observation[number])[0])
            except (AssertionError, ValueError):
                continue  # Meta-World raises for some states that physics never reaches
            compared[number] += 1
            full[number] += expected == 10.0
            seen_rewards[number].add(expected)
            if expected != got[number]:
                wrong[TASKS[number]].append((expected, got[number]))
    assert not wrong
    assert compared.min() > 100, dict(zip(TASKS, compared.tolist(), strict=True))
    assert min(map(len, seen_rewards)) > 10
    never = {task for task, count in zip(TASKS, full, strict=True) if not count}
    unlimited = {"press", "press behind wall", "sum", "both", "reach"}
    assert {reward_table()[task].formula for task in never} <= unlimited, never


def test_reward_does_not_depend_on_other_rows():
    tasks = ["push", "dial-turn", "bin-picking", "push", "peg-insert-side"]
    together = VectorizedEngine(tasks, reward="dense", num_threads=1)
    alone = [VectorizedEngine([task], reward="dense", num_threads=1) for task in tasks]
    rng = np.random.default_rng(0)
    together.reset(range(5), range(5))
    for number, engine in enumerate(alone):
        engine.reset([0], [number])
    for _ in range(40):
        active = rng.random(5) < 0.6
        action = rng.uniform(-1, 1, (5, 4)).astype(np.float32)
        got = together.step(action, active).reward
        expected = [engine.step(action[k : k + 1], active[k : k + 1]).reward[0] for k, engine in enumerate(alone)]
        assert got.tolist() == expected


def test_reset_forgets_the_previous_episodes_first_distance():
    """bin-picking uses the distance after the first step."""
    engine = VectorizedEngine(["bin-picking"], reward="dense", num_threads=1)
    everyone, action = np.ones(1, bool), np.ones((1, 4), np.float32)
    rewards = []
    for seed in (0, 1, 0):
        engine.reset([0], [seed])
        rewards.append([engine.step(action, everyone).reward[0] for _ in range(5)])
    assert rewards[0] == rewards[2] != rewards[1]


def test_tolerance_and_its_curves_have_metaworlds_bits():
    rng = np.random.default_rng(0)
    x, margin = 0.3 * rng.random(5000), 0.3 * rng.random(5000)
    x[:50] = np.repeat([0.0, 0.05, 0.1, 0.02, 0.2], 10)
    margin[:5000:100] = 0.0
    pairs = [(float(a), float(b)) for a, b in zip(x, margin, strict=True)]
    expected = [reward_utils.tolerance(a, (0.05, 0.1), b, "long_tail") for a, b in pairs]
    with np.errstate(divide="ignore", invalid="ignore"):
        assert terms.tolerance(x, 0.05, 0.1, margin).tolist() == expected
    for name, curve in (("long_tail", terms.long_tail), ("gaussian", terms.gaussian)):
        expected = [reward_utils.tolerance(float(a), (0.0, 0.0), 1.0, name) for a in x + 1e-9]
        assert curve(x + 1e-9).tolist() == expected


def test_hamacher_product_has_metaworlds_bits():
    a, b = np.random.default_rng(0).random((2, 5000))
    a[:100], b[50:150] = 0.0, 0.0
    expected = [reward_utils.hamacher_product(float(p), float(q)) for p, q in zip(a, b, strict=True)]
    with np.errstate(invalid="ignore"):
        assert terms.hamacher_product(a, b).tolist() == expected


def test_square_is_that_of_pow():
    x = np.random.default_rng(0).normal(size=100000)
    squares = terms.square(x)
    assert squares.tolist() == [float(value) ** 2 for value in x]
    assert (squares != x * x).any(), "the test would not distinguish pow from x * x"


def test_table_has_a_reward_for_every_task_and_uses_every_formula():
    table = reward_table()
    assert (list(table), {reward.formula for reward in table.values()}) == (TASKS, set(FORMULAS))
    assert {reward.lift for reward in table.values()} - {None} == set(LIFTS)
