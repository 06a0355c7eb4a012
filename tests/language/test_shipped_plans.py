"""The shipped MT10 plans: their form, and whether their conditions describe what an expert goes through."""

from importlib.resources import files

import numpy as np
import pytest
import torch

from lw_torchrl.envs.metaworld_engine import import_metaworld, make_metaworld_env
from lw_torchrl.language.plans import format_plan, load_plans, parse_plan
from lw_torchrl.language.query_program import QueryProgram
from lw_torchrl.language.tasks import MT10, task_id

EPISODES = 6  # for each task, half of them with execution noise
NOISE = 0.1
AFTER_SUCCESS = 20  # steps after the first success that still count as the task's states
LIMIT = 300  # steps after which an expert has failed


def plan_text(task):
    return (files("lw_torchrl.language") / "data" / "plans" / f"{task}.plan").read_text("utf-8")


def expert_episodes(task):
    """Expert episodes: observations (T, 39) float32, and the first success, T where there is none."""
    policies = import_metaworld().policies
    env = make_metaworld_env(task)
    episodes = []
    for seed in range(EPISODES):
        rng = np.random.default_rng(seed)
        policy = policies.ENV_POLICY_MAP[f"{task}-v3"]()
        env.seed(seed)
        observation, _ = env.reset()
        seen, first = [], None
        while len(seen) < LIMIT and (first is None or len(seen) <= first + AFTER_SUCCESS):
            seen.append(observation.astype(np.float32))
            # A copy, because the expert of door-open writes into what it is given.
            action = np.clip(policy.get_action(observation.copy()), -1, 1)
            if seed % 2:
                action = np.clip(action + NOISE * rng.standard_normal(4), -1, 1)
            observation, _, _, _, info = env.step(action)
            if first is None and info["success"]:
                first = len(seen) - 1
        episodes.append((torch.from_numpy(np.stack(seen)), len(seen) if first is None else first))
    env.close()
    return episodes


def percent(share):
    return f"{100 * float(share):5.1f} %"


@pytest.mark.parametrize("task", MT10)
def test_file_is_canonical(task):
    text = plan_text(task)
    assert format_plan(parse_plan(text, task)) == text


@pytest.mark.parametrize("task", MT10)
def test_has_three_to_six_reasoned_steps(task):
    steps = load_plans("MT10")[task].steps
    assert 3 <= len(steps) <= 6
    assert all(step.reason for step in steps)
    assert len({step.condition for step in steps}) == len(steps)


def test_skills_are_shared_between_tasks():
    skills = load_plans("MT10").skills
    verbs = {skill.split()[0] for skill in skills}
    assert verbs == {"place", "center", "lower", "close", "move", "hold", "push", "pull"}


@pytest.mark.filterwarnings(r"ignore:Constant\(s\) may be too high")
@pytest.mark.parametrize("task", MT10)
def test_conditions_cover_what_an_expert_passes_through(task):
    plan = load_plans("MT10")[task]
    program = QueryProgram({task: [step.condition for step in plan.steps]})
    before, around = [], []
    for observations, first in expert_episodes(task):
        true = program(observations, torch.full((len(observations),), task_id(task)))
        before.append(true[: first + 1])
        around.append(true)
    before, active = torch.cat(before), torch.cat(around).float().mean(0)

    covered = before.any(1).float().mean()
    median = before.sum(1).float().median()
    table = [
        f"{task}, {EPISODES} expert episodes: {percent(covered)} covered, {median:.0f} true (median)",
        f"   before | to {AFTER_SUCCESS} steps after success | skill: condition",
    ]
    for step, earlier, share in zip(plan.steps, before.float().mean(0), active, strict=True):
        table.append(f"  {percent(earlier)} | {percent(share):>25} | {step.skill}: {step.condition}")
    report = "\n".join(table)

    assert covered >= 0.9, report
    assert median <= 2, report
    assert active.min() >= 0.01, report
    assert active.max() <= 0.95, report
