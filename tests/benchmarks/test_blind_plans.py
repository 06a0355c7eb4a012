"""Plans that read no text, and the table that measures other plans over the best of them."""

from benchmarks.any_plans import DEVELOPMENT, TEST, report
from benchmarks.blind_plans import blind_plans


def test_chooser_picks_motions_from_geometry():
    """A puck behind a wall, a puck on the table, a drawer to push, one to pull, a button to press, no object at all."""
    tasks = ["push-wall", "push", "drawer-close", "drawer-open", "button-press-topdown", "reach"]
    own = {
        task: [step.role for step in plan.steps if not step.role.fallback][-1]
        for task, plan in blind_plans("chooser", tasks).items()
    }
    found = [(own[task].verb, own[task].manner) for task in tasks]
    assert found == [
        ("carry", "grasp"), ("move", "grasp"), ("push", "push"), ("move", "grasp"), ("push", "press"), ("hold", "reach")
    ]  # fmt: skip


def test_plans_are_compared_with_the_best_blind_plan_of_each_split():
    rates = {"default": (0.2, 0.6), "carried": (0.5, 0.4), "natural": (0.9, 0.7)}
    found = [
        {"row": row, "seed": seed, "success": dict.fromkeys(DEVELOPMENT, at[0]) | dict.fromkeys(TEST, at[1])}
        for row, at in rates.items()
        for seed in (0, 1)
    ]
    head, _, _, _, natural = report(found, 20).splitlines()
    assert "minus carried" in head.split("20 test")[0]
    assert "minus default" in head.split("20 test")[1]
    assert natural.count("0.400 [0.400, 0.400]") == natural.count("0.100 [0.100, 0.100]") == 1
    assert "20, 0" in natural
