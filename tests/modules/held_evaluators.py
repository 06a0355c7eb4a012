"""Small learned evaluators, and episodes in which they are asked."""

import torch

import lw_torchrl as lw

TASKS = ("drawer-open", "reach")
PLANS = lw.Plans({task: lw.load_plans("MT10")[task] for task in TASKS})
ROWS = 4


def letters(texts):
    return torch.tensor([[float(text.count(letter)) for letter in "abdefghilnoprstuw"] for text in texts])


def learned(plans=PLANS, **options):
    torch.manual_seed(0)
    return lw.StateQueryEvaluator(plans, width=8, depth=1, **options)


def evaluated(actor, **options):
    settings = {"tasks": TASKS, "episodes_per_task": 2, "seed": 1000, "max_steps": 12, "progress": False}
    seen = {}
    keep = lambda one: seen.__setitem__((one.task, one.episode), one.steps)  # noqa: E731
    result = lw.evaluate(actor, record_actions=True, on_episode=keep, **settings | options)
    return [one.actions for one in result.episodes], seen


def same(found, expected):
    return all(torch.equal(one, other) for one, other in zip(found, expected, strict=True))
