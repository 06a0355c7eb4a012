"""Small actors of every kind, and rows that they read."""

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential

import lw_torchrl as lw
from lw_torchrl import modules as m

PLANS = lw.load_plans("MT10")
CANONICAL = lw.canonical_plans(PLANS)
FALLBACK = lw.canonical_plans(PLANS, fallback=True)


def letters(texts):
    """Return text vectors that count vowels."""
    return torch.tensor([[float(text.count(letter)) for letter in "aeiou"] for text in texts])


def small_decoder(**options):
    return m.MLPDecoder(**{"width": 16, "depth": 1, **options})


def make_actor(plans=PLANS, seed=0, **options):
    torch.manual_seed(seed)
    small = {"skill_encoder": m.SkillEncoder(6, width=12), "decoder": small_decoder()}
    return lw.PlanConditionedActor(plans, **{**small, **options}).eval()


def make_descriptor(tasks="MT10", seed=0, **options):
    torch.manual_seed(seed)
    small = {"task_encoder": m.SkillEncoder(6, width=12), "decoder": small_decoder()}
    return lw.modules.DescriptorConditionedActor(tasks, **{**small, **options}).eval()


def make_role_actor(plans=CANONICAL, seed=0, **options):
    return make_actor(plans, seed, features=m.RoleFeatures(plans), **options)


ACTORS = {
    "plan": make_actor,
    "focus": lambda: make_actor(features=m.Concat(m.ObservationFeatures(), m.FocusFeatures(PLANS))),
    "roles": make_role_actor,
    "fallback": lambda: make_role_actor(FALLBACK),
    "tanh_normal": lambda: make_actor().stochastic(),
    "normal": lambda: make_descriptor().stochastic("normal"),
    "description": make_descriptor,
    "one-hot": lambda: make_descriptor(condition="one-hot"),
    "scripted": lambda: lw.ScriptedSkillActor(PLANS),
    "evaluator": lambda: TensorDictSequential(lw.modules.StateQueryEvaluator(PLANS, width=8), make_actor()),
    "ensemble": lambda: m.ActorEnsemble([make_actor(seed=seed) for seed in range(2)]),
    "decided": lambda: m.DecidedGripper(make_actor()),
    "demonstrated": lambda: m.DemonstratedActor(make_descriptor(["push", "reach"]), make_role_actor()),
}


def make_rows(*shape, plans=PLANS, seed=0, answered=True):
    """Return random states of the plans' tasks, with random ``qaf``, which is false beyond a plan's last step."""
    generator = torch.Generator().manual_seed(seed)
    chosen = torch.randint(len(plans), tuple(shape), generator=generator)
    ids, lengths = torch.tensor([(lw.task_id(name), len(plan.steps)) for name, plan in plans.items()])[chosen].unbind(
        -1
    )
    rows = TensorDict(observation=torch.rand(*shape, 39, generator=generator), task_id=ids, batch_size=shape)
    if not answered:
        return rows
    truth = torch.rand(*shape, plans.num_steps, generator=generator) > 0.6
    return rows.set("qaf", truth & (torch.arange(plans.num_steps) < lengths.unsqueeze(-1)))


def rows_for(actor, *shape, seed=0):
    """Return states with exact answers, as ``actor`` reads them."""
    rows = make_rows(*shape, plans=m.plans_of(actor) or PLANS, seed=seed, answered=False)
    transform = m.transform_of(actor)
    return rows if transform is None else transform(rows)


def action_of(actor, rows):
    return actor(rows.copy())["action"]


def assert_a_logit_for_each_step(evaluator, rows):
    """Check and return an evaluator's logits for 64 rows, the size of evaluation's blocks, in any order and shape."""
    logits = evaluator(rows.clone())["qaf_logits"]
    assert logits.shape == (64, evaluator.plans.num_steps)
    assert logits.dtype == torch.float32
    for row, task in enumerate(rows["task_id"].tolist()):
        steps = len(evaluator.plans[lw.MT50[task]].steps)
        assert (logits[row, :steps].abs() <= 31).all()
        assert (logits[row, steps:] == -1e4).all()
    order = torch.randperm(64)
    assert torch.equal(evaluator(rows[order])["qaf_logits"], logits[order])
    assert torch.equal(evaluator(rows.reshape(4, 16))["qaf_logits"].reshape(64, -1), logits)
    return logits
