"""Latches, conditions that remember: QAFTransform and datasets equal an interpreter that walks through each episode."""

import random
from functools import partial
from itertools import chain

import pytest
import torch
from conditions import visit_with_memory
from random_states import RandomStates
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

import lw_torchrl as lw
from lw_torchrl.language import query_program
from lw_torchrl.language.expressions import Expression, Once, all_of, any_of, evaluate, fold, leaves, negate, once
from lw_torchrl.language.plans import PlanStep
from lw_torchrl.language.queries import Clause, Query, parse_query
from lw_torchrl.language.query_program import QueryProgram

CLAUSES = {
    "push": [*(Clause("robot's gripper", *words) for words in (("near", "puck"), ("left of", "puck"), ("open",)))],
    "reach": [Clause("robot's gripper", relation, "reach target") for relation in ("left of", "above")],
}
CLAUSES["push"].append(Clause("puck", "above", "target location"))
TASKS = ["push", "reach"]
ROWS = 10
IDS = [lw.task_id(TASKS[row % 2]) for row in range(ROWS)]


class RandomEnv(RandomStates):
    """Random states in which conditions on positions are often true; row i has episodes of ``length + i`` steps."""

    def _state(self, **more: torch.Tensor) -> TensorDict:
        state = super()._state(**more)
        return state.set("observation", 0.2 * state["observation"])


def random_condition(draw: random.Random, task: str, depth: int = 4) -> Expression:
    if depth == 0 or draw.random() < 0.15:
        leaf = draw.choice(CLAUSES[task])
        return negate(leaf) if draw.random() < 0.5 else all_of([leaf])
    if draw.random() < 0.4:
        latch = once(random_condition(draw, task, depth - 1))
        return negate(latch) if draw.random() < 0.3 else latch
    join = draw.choice([all_of, any_of])
    return join(random_condition(draw, task, depth - 1) for _ in range(draw.randint(2, 3)))


def random_plans(seed: int) -> lw.Plans:
    """Return plans whose conditions have latches in latches; the plans have unequal numbers of steps and latches."""
    draw, plans = random.Random(seed), []
    for task, steps in zip(TASKS, (5, 2), strict=True):
        conditions = [Query(random_condition(draw, task)) for _ in range(steps)]
        conditions[0] = Query(once(all_of([CLAUSES[task][1], once(CLAUSES[task][0])])))
        plans.append(lw.ConditionalPlan.from_pairs(task, [(each, "open the gripper") for each in conditions]))
    return lw.Plans(plans)


class Interpreter:
    """An interpreter that evaluates one row, one step at a time, with a set of the latches that are true."""

    def __init__(self, plans: lw.Plans) -> None:
        self.conditions = {task: [step.condition.expression for step in plan.steps] for task, plan in plans.items()}
        self.steps = plans.num_steps
        self.clauses = {task: [*dict.fromkeys(chain(*map(leaves, own)))] for task, own in self.conditions.items()}
        self.programs = {task: QueryProgram({task: list(map(str, own))}) for task, own in self.clauses.items()}

    def episode(self, task: str, observation: torch.Tensor) -> torch.Tensor:
        """Return the truth (T, S) of the conditions in an episode's observations (T, 39)."""
        ids = torch.full((len(observation),), lw.task_id(task))
        facts, latched = self.programs[task](observation, ids).tolist(), set[Once]()
        truth = torch.zeros(len(observation), self.steps, dtype=torch.bool)
        for step, values in enumerate(facts):
            state = dict(zip(self.clauses[task], values, strict=True))
            visit = visit_with_memory(state, latched)
            answers = [fold(condition, visit) for condition in self.conditions[task]]
            truth[step, : len(answers)] = torch.tensor(answers)
        return truth


def check_rollout(rollout: TensorDictBase, plans: lw.Plans) -> int:
    """Compare ``qaf`` (N, T) at the root and under "next" with the interpreter; return the number of episodes."""
    interpreter, count = Interpreter(plans), 0
    for row in rollout.reshape(-1, rollout.shape[-1]).unbind(0):
        task = lw.MT50[row["task_id"][0]]
        ends = [*(row["next", "done"].flatten().nonzero().flatten() + 1).tolist(), len(row)]
        start = 0
        for end in dict.fromkeys(ends):
            steps = row[start:end]
            if len(steps):
                seen = torch.cat((steps["observation"], steps["next", "observation"][-1:]))
                expected = interpreter.episode(task, seen)
                assert torch.equal(steps["qaf"], expected[:-1])
                assert torch.equal(steps["next", "qaf"], expected[1:])
                count += 1
            start = end
    return count


@pytest.mark.parametrize("kernel", [True, False])
def test_1000_random_episodes_with_partial_resets_equal_the_interpreter(kernel, monkeypatch):
    if not kernel:
        monkeypatch.setattr(query_program, "find_kernel", lambda: None)
    count = 0
    for seed in range(4):
        plans = random_plans(seed)
        env = TransformedEnv(RandomEnv(ROWS, 3, seed), lw.QAFTransform(plans))
        assert env.transform.program.num_latches > 2
        rollout = env.rollout(200, break_when_any_done=False)
        assert rollout["qaf"].any()
        count += check_rollout(rollout, plans)
    assert count >= 1_000


@pytest.fixture
def few_latches() -> lw.Plans:
    """Return plans with two latches for push, the second in turn after the first, and none for reach."""
    near, left = "the gripper has been near the puck", "the gripper is left of the puck"
    push = [(near, "push the puck"), (f"once ({near} and {left})", "close the gripper"), ("always", "open the gripper")]
    reach = [("the gripper is above the reach target", "move down")]
    pairs = {"push": push, "reach": reach}
    return lw.Plans([lw.ConditionalPlan.from_pairs(task, steps) for task, steps in pairs.items()])


def test_resumed_rollouts_continue_the_latches():
    plans = random_plans(7)
    whole, env = (TransformedEnv(RandomEnv(ROWS, 8), lw.QAFTransform(plans)) for _ in range(2))
    whole = whole.rollout(30, break_when_any_done=False)
    parts = [env.rollout(13, break_when_any_done=False)]
    state = env.step_mdp(parts[0][:, -1])
    state = env.reset(state.set("_reset", state["done"].clone())) if state["done"].any() else state
    parts.append(env.rollout(17, break_when_any_done=False, auto_reset=False, tensordict=state.exclude("_reset")))
    assert torch.equal(torch.cat(parts, 1)["qaf"], whole["qaf"])
    check_rollout(torch.cat(parts, 1), plans)


@pytest.mark.parametrize("inside", [True, False])
def test_workers_of_a_serial_env_keep_latches(inside):
    plans = random_plans(8)

    def make(seed: int) -> EnvBase:
        env = RandomEnv(6, 3, seed)
        return TransformedEnv(env, lw.QAFTransform(plans)) if inside else env

    workers: EnvBase = SerialEnv(2, [partial(make, seed) for seed in (10, 20)])
    env = workers if inside else TransformedEnv(workers, lw.QAFTransform(plans))
    rollout = env.rollout(40, break_when_any_done=False)
    assert check_rollout(rollout, plans) > 12
    env.close()


def test_a_reset_by_hand_clears_only_the_latches_of_its_rows(few_latches):
    env = TransformedEnv(RandomEnv(ROWS), lw.QAFTransform(few_latches))
    check_env_specs(env)
    assert env.reset()["qaf_latches"].shape == (ROWS, 2)
    state = env.rollout(200, break_when_any_done=False)[:, -1]["next"]
    mask, before = torch.arange(ROWS) % 3 == 0, state["qaf_latches"]
    assert before[0::2].float().mean() > 0.3
    assert not before[1::2].any()
    fresh = env.reset(state.clone().set("_reset", mask))
    assert torch.equal(fresh["qaf_latches"][~mask], before[~mask])
    program = QueryProgram({"push": [str(CLAUSES["push"][0])], "reach": ["never"]})
    near = program(fresh["observation"], fresh["task_id"]).flatten()
    assert torch.equal(fresh["qaf_latches"][mask, 0], near[mask])


@pytest.mark.parametrize("options", [{}, {"n_steps": 3, "gamma": 0.9}, {"after_success": 5}])
def test_a_dataset_recomputes_the_latches_of_the_environment(tmp_path, options, few_latches):
    lw.collect_demonstrations(["push", "reach"], episodes_per_task=2, root=tmp_path / "demos", max_steps=70)
    options |= {"label": "executed", "batch_size": 16}
    replay = lw.LanguageWorldExperienceReplay(tmp_path / "demos", transform=lw.QAFTransform(few_latches), **options)
    rows, interpreter = replay[:], Interpreter(few_latches)
    assert rows["qaf"].any()
    for number in rows["collector", "traj_ids"].unique():
        episode = rows[rows["collector", "traj_ids"] == number]
        task = lw.MT50[episode["task_id"][0]]
        assert torch.equal(episode["qaf"], interpreter.episode(task, episode["observation"]))
        if len(options) == 2:
            seen = torch.cat((episode["observation"], episode["next", "observation"][-1:]))
            assert torch.equal(episode["next", "qaf"], interpreter.episode(task, seen)[1:])
        if "n_steps" in options:
            later = episode["steps_to_next_obs"] == 3
            later[-3:] = False
            assert torch.equal(episode["next", "qaf"][later], episode["qaf"][3:][later[:-3]])
    info = replay.sample(return_info=True)
    assert torch.equal(info[0]["qaf"], rows["qaf"][info[1]["index"]])
    appended = lw.LanguageWorldExperienceReplay(tmp_path / "demos", **options)
    appended.append_transform(lw.QAFTransform(few_latches))
    assert torch.equal(appended[:]["qaf"], rows["qaf"])


def test_what_has_no_history_is_refused(few_latches):
    program = lw.QAFTransform(few_latches).program
    observation, ids = torch.zeros(2, 39), torch.tensor(IDS[:2])
    with pytest.raises(ValueError, match=r"latches must be bool of shape \(2, 2\), .*earlier steps"):
        program(observation, ids)
    with pytest.raises(ValueError, match="latches must be bool of shape"):
        program(observation, ids, torch.zeros(2, 3))
    rows = TensorDict(observation=observation, task_id=ids, batch_size=[2])
    with pytest.raises(ValueError, match=r"rows lack 'qaf_latches'.*LanguageWorldExperienceReplay"):
        lw.QAFTransform(few_latches)(rows)
    with pytest.raises(ValueError, match=r"learned evaluator.*push depend on earlier steps"):
        lw.modules.StateQueryEvaluator(few_latches)


def test_soft_truth_has_the_sign_of_the_exact_truth_and_finite_gradients():
    for seed in range(5):
        program = lw.QAFTransform(random_plans(seed)).program
        observation = (0.1 * torch.randn(200, 39)).requires_grad_()
        ids = torch.tensor(IDS * 20)
        latches = torch.rand(200, program.num_latches) < 0.5
        exact = program(observation.detach(), ids, latches)
        for truth in ("min-max", "product"):
            soft = program.logits(observation, ids, latches, truth=truth)
            (gradient,) = torch.autograd.grad(soft.sum(), observation)
            assert gradient.isfinite().all()
            if truth == "min-max":
                assert torch.equal(soft > 0, exact)


SPELLINGS = {
    "the gripper has been near the puck": "G has been near the puck",
    "the puck was once near the target location": "the puck has been near the target location",
    "the gripper hasn't been open": "G has not been open",
    "the gripper has never been open": "G has not been open",
    "once (the gripper is open)": "G has been open",
    "once not (the gripper is open)": "once (G is not open)",
    "not once (the gripper is open and near the puck)": "not once (G is open and G is near the puck)",
    "once (gripper has been open and near puck)": "once (G has been open and G is near the puck)",
}


@pytest.mark.parametrize(("text", "canonical"), SPELLINGS.items())
def test_spellings(text, canonical):
    query, canonical = parse_query(text, "push"), canonical.replace("G", "the robot's gripper")
    assert str(query) == canonical
    assert parse_query(canonical, "push") == query
    assert (query.has_latch, query.is_conjunction, not query.implied) == (True, False, True)


def test_random_conditions_are_read_back_as_printed():
    draw = random.Random(0)
    for _ in range(300):
        query = Query(random_condition(draw, "push"))
        if query.expression.parts or query.expression.kind == "leaf":
            assert parse_query(str(query), "push") == query


def test_without_memory_a_latch_is_its_condition():
    query = parse_query("the gripper has not been open or once (the gripper is closed and near the puck)", "push")
    assert str(query.present) == (
        "the robot's gripper is not open or the robot's gripper is closed and the robot's gripper is near the puck"
    )
    truth = {leaf: leaf.predicate == "open" for leaf in leaves(query.expression)}
    assert evaluate(query.expression, truth) == evaluate(query.present.expression, truth)
    with pytest.raises(lw.PlanError, match="a goal must not contain"):
        lw.ConditionalPlan("push", (PlanStep(query, "open the gripper", goal=query),))


def test_evaluate_runs_a_plan_that_latches():
    near = "once (the gripper is near the reach target)"
    pairs = [(condition, "move the gripper to the reach target") for condition in (near, f"not {near}")]
    plans = lw.Plans([lw.ConditionalPlan.from_pairs("reach", pairs)])
    actor, done = lw.ScriptedSkillActor(plans), ("next", "qaf")
    result = lw.evaluate(actor, tasks="reach", episodes_per_task=3, seed=5, max_steps=60, num_envs=2)
    assert result.success_once == {"reach": 1.0}
    env = TransformedEnv(lw.LanguageWorldEnv("reach", num_envs=3, max_steps=25), lw.QAFTransform(plans))
    check_env_specs(env)
    first = env.rollout(60, actor, break_when_any_done=False)
    assert first[done].any()
    assert check_rollout(first, plans) == 9
