"""A custom plan format: how to write plans, prompt a language model for them, and parse the model's answer.

lw-torchrl plan prompt drawer-open --format arrows --import my_format
lw-torchrl plan read answer.txt --task drawer-open --format arrows --import my_format
"""

import lw_torchrl as lw
from lw_torchrl.language.formats import Clause, PlanFormat, Reading


def encode(plan):
    return "".join(f"{step.condition} -> {step.skill}\n" for step in plan.steps)


def read(text):  # must not raise for any text, because models can answer anything
    found = Reading()
    for number, line in enumerate(text.splitlines(), 1):
        condition, arrow, skill = line.partition("->")
        if arrow:
            found.section.clauses.append(Clause(number, condition.strip(), skill.strip()))
        elif line.strip():
            found.note(number, f"no step: {line.strip()}")
    return found


def prompt(examples, task, hints):  # plans of other tasks, the task, and lines that describe the possible conditions
    shown = [f"{plan.definition.description}\n{encode(plan)}" for plan in examples]
    return "\n".join(["Plans with one line per step: condition -> skill.\n", *shown, *hints, task.description, ""])


lw.PLAN_FORMATS["arrows"] = PlanFormat("txt", encode, read, prompt)
