"""SwapUnmentioned and JitterTarget: augmentations of a replay buffer's rows."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.envs import Compose, StepCounter, TransformedEnv

import lw_torchrl as lw
from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.language.task_index import PlanTables
from lw_torchrl.transforms.augmentation import mentioned

PLACES = {0: [*range(4, 11), *range(22, 29)], 1: [*range(11, 18), *range(29, 36)], 2: [36, 37, 38]}
MT10 = lw.load_plans("MT10")
CANONICAL = lw.canonical_plans(MT10, fallback=True)


MENTIONED = [
    ("push", "the gripper is above the puck", "lower the gripper", [1, 0, 0]),
    ("push", "the gripper is open", "move the puck to the target location", [1, 0, 1]),
    ("push", "the gripper is open", "wait", [0, 0, 0]),
    ("hammer", "the gripper is above the hammer handle", "wait", [1, 0, 0]),  # a named point of the first object
    ("hammer", "the hammer head is near the nail", "wait", [1, 1, 0]),
    ("bin-picking", "the gripper is above the other bin", "wait", [0, 0, 0]),  # a fixed place
]


@pytest.mark.parametrize(("task", "condition", "skill", "objects"), MENTIONED)
def test_conditions_and_skills_mention_objects(task, condition, skill, objects):
    plans = Plans([ConditionalPlan.from_pairs(task, [(condition, skill), ("the gripper is open", "wait")])])
    assert mentioned(plans, PlanTables(plans))[0].int().tolist() == [objects, [0, 0, 0]]


@pytest.mark.parametrize("skills", ["own", "MT10"])
def test_a_canonical_step_mentions_what_it_moves_and_its_target(skills):
    """Even if its text does not: "lift the puck out of the hole" is on its way to the target location."""
    plans = lw.canonical_plans(lw.load_plans("MT50", skills=skills))
    tables = PlanTables(plans)
    result = mentioned(plans, tables)
    for task, plan in plans.items():
        for number, step in enumerate(plan.steps):
            if "target location" in (step.role.moved, step.role.target):
                assert result[tables.index.row(task), number, 2], (task, step.skill)


# One condition of push for each row: the puck alone is mentioned, or the goal too.
CONDITIONS = ("the gripper is above the puck", "the puck is near the target location")
PUSH = Plans([ConditionalPlan.from_pairs("push", [(each, "wait") for each in CONDITIONS])])
KEPT = torch.tensor([[True, False, False], [True, False, True]])


def rows(number=8, seed=0, plans=PUSH, task="push", step=None):
    generator = torch.Generator().manual_seed(seed)
    result = TensorDict(observation=torch.randn(number, 39, generator=generator)).auto_batch_size_(1)
    result["task_id"] = torch.full((number,), lw.task_id(task))
    result["qaf"] = torch.rand(number, plans.num_steps, generator=generator) < 0.5
    if step is not None:
        result["qaf"] = torch.nn.functional.one_hot(torch.as_tensor(step).expand(number), plans.num_steps).bool()
    return result


def seeded(transform, tensordict, seed=0):
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return transform(tensordict)


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 30), st.integers(0, 2**31), st.floats(0.0, 1.0), st.booleans())
def test_only_unmentioned_objects_are_swapped_with_another_row(number, seed, probability, soft):
    was = rows(number, seed)
    if soft:
        was["qaf"] = was["qaf"].float() * 0.9 + 0.05
    before = was.clone()
    now = seeded(lw.transforms.SwapUnmentioned(PUSH, probability), was, seed)
    assert (was == before).all()
    true = was["qaf"] > 0.5
    active = true | ~true.any(-1, keepdim=True)  # attention is uniform where no condition is true
    kept = (active.unsqueeze(-1) & KEPT).any(1)
    observation, swapped = was["observation"], now["observation"]
    others = [column for column in range(39) if not any(column in place for place in PLACES.values())]
    assert torch.equal(swapped[:, others], observation[:, others])
    for thing, place in PLACES.items():
        assert torch.equal(swapped[kept[:, thing]][:, place], observation[kept[:, thing]][:, place])
        for row in swapped[:, place]:
            assert (observation[:, place] == row).all(-1).any()
    assert torch.equal(now["qaf"], was["qaf"]), "answers belong to the unchanged scene"


def test_swap_probability_holds_for_each_object():
    was = rows(4000, step=0)
    was["observation"] = torch.arange(4000.0)[:, None].expand(-1, 39).clone()
    moved = seeded(lw.transforms.SwapUnmentioned(PUSH, 0.3), was)["observation"] != was["observation"]
    assert moved[:, 36].float().mean().item() == pytest.approx(0.3, abs=0.03)
    assert torch.equal(moved[:, 11], moved[:, 35])
    assert not torch.equal(moved[:, 11], moved[:, 36])
    assert not moved[:, 4].any()
    shaped = seeded(lw.transforms.SwapUnmentioned(PUSH, 0.3), was.reshape(40, 100))["observation"]
    assert shaped.shape == (40, 100, 39)
    assert torch.equal(shaped.reshape(-1, 39) != was["observation"], moved)


def test_next_observation_is_swapped_alike():
    was = rows(64, step=0)
    was["next"] = TensorDict(observation=was["observation"] + 100, batch_size=[64])
    now = seeded(lw.transforms.SwapUnmentioned(PUSH, 1.0), was)
    assert torch.equal(now["next", "observation"], now["observation"] + 100)
    assert not torch.equal(now["observation"][:, 36:], was["observation"][:, 36:])
    was["next", "qaf"] = rows(64, step=1)["qaf"]
    kept = seeded(lw.transforms.SwapUnmentioned(PUSH, 1.0), was)
    assert torch.equal(kept["observation"][:, 36:], was["observation"][:, 36:])
    assert torch.equal(kept["next", "observation"], kept["observation"] + 100)


def test_fallback_steps_mention_nothing_in_the_plans_own_turn():
    plan = next(plan for plan in CANONICAL.values() if plan.steps[-1].role.fallback)
    own = sum(not step.role.fallback for step in plan.steps)
    transform = lw.transforms.SwapUnmentioned(CANONICAL, 1.0)
    was = rows(task=plan.task, plans=CANONICAL, step=own)
    active, _ = transform.active(was, ["qaf", "task_id"])
    assert active[:, :own].all(), "without a true condition in its turn, attention is uniform"
    assert not active[:, own:].any()
    active, _ = transform.active(was.set("turn", torch.ones(8, dtype=torch.int64)), ["qaf", "task_id"])
    assert active.sum(-1).tolist() == [1] * 8
    assert active[:, own].all()


def test_target_offset_only_for_pushed_or_pulled_objects():
    transform, kinds = lw.transforms.JitterTarget(CANONICAL, 0.03), set()
    for task, plan in CANONICAL.items():
        for number, step in enumerate(plan.steps):
            kinds.add(pushes := step.role.verb in ("push", "pull"))
            if not step.role.fallback:
                was = rows(4000 if pushes else 8, plans=CANONICAL, task=task, step=number)
                offset = seeded(transform, was)["target_offset"]
                assert offset.std(0).tolist() == pytest.approx([0.015, 0.015, 0.03] if pushes else [0] * 3, rel=0.1)
                assert offset.mean(0).abs().max() < 0.003
    assert kinds == {True, False}


def test_renamed_keys():
    was = rows(64, step=0)
    moved = TensorDict({("a", "seen"): was["observation"], ("a", "task"): was["task_id"], "truth": was["qaf"]}, [64])
    keys = [("a", "seen"), ("a", "task"), "truth"]
    expected = seeded(lw.transforms.SwapUnmentioned(PUSH, 1.0), was)["observation"]
    assert torch.equal(seeded(lw.transforms.SwapUnmentioned(PUSH, 1.0, in_keys=keys), moved)["a", "seen"], expected)
    moved = seeded(lw.transforms.JitterTarget(PUSH_ROLES, 0.1, in_keys=keys[1:]), moved)
    assert moved["target_offset"].shape == (64, 3)


@pytest.mark.parametrize("name", ["SwapUnmentioned", "JitterTarget", "RandomYaw"])
def test_call_with_no_rows_or_in_an_environment(name):
    was = rows(plans=CANONICAL).set("action", torch.zeros(8, 4))[:0]
    assert MAKERS[name]()(was)["observation"].shape == (0, 39)
    env = TransformedEnv(lw.LanguageWorldEnv("push"), Compose(StepCounter(), MAKERS[name]()))
    with pytest.raises(TypeError, match=f"{name} is only for replay buffers"):
        env.reset()
    env.base_env.close()


PUSH_ROLES = Plans([ConditionalPlan("push", CANONICAL["push"].steps[:2])])
MAKERS = {
    "SwapUnmentioned": lambda: lw.transforms.SwapUnmentioned(CANONICAL, 0.5),
    "JitterTarget": lambda: lw.transforms.JitterTarget(CANONICAL, 0.03),
    "RandomYaw": lambda: lw.RandomYaw(0.1),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", MAKERS)
def test_augmentation_compiles_to_one_graph(name):
    torch._dynamo.reset()
    compiled = torch.compile(MAKERS[name](), fullgraph=True, backend="eager")
    assert compiled(rows(plans=CANONICAL).set("action", torch.zeros(8, 4))).batch_size == (8,)
