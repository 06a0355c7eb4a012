"""A plan format of your own: how plans are written, asked of a language model, and read from its answer.

lw-torchrl plan prompt drawer-open --format arrows --import my_format
lw-torchrl plan read answer.txt --task drawer-open --format arrows --import my_format
"""

import lw_torchrl as lw
from lw_torchrl.language.formats import Clause, PlanFormat, Reading


def encode(plan):
    return "".join(f"{step.condition} -> {step.skill}\n" for step in plan.steps)


def read(text):  # of any text, since models write anything; it never raises
    found = Reading()
    for number, line in enumerate(text.splitlines(), 1):
        condition, arrow, skill = line.partition("->")
        if arrow:
            found.section.clauses.append(Clause(number, condition.strip(), skill.strip()))
        elif line.strip():
            found.note(number, f"no step: {line.strip()}")
    return found


def prompt(examples, task, hints):  # other tasks' plans, the task, and lines that say what can be asked
    shown = [f"{plan.definition.description}\n{encode(plan)}" for plan in examples]
    return "\n".join(["Plans, a line for each step: condition -> skill.\n", *shown, *hints, task.description, ""])


lw.PLAN_FORMATS["arrows"] = PlanFormat("txt", encode, read, prompt)
