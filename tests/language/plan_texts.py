"""Plans for tests: written by hand, drawn, and from the tables beside the tests."""

import tomllib
from pathlib import Path

from hypothesis import strategies as st

from lw_torchrl.language.plans import ConditionalPlan, PlanStep
from lw_torchrl.language.queries import parse_query, supported_queries
from lw_torchrl.language.tasks import MT50

DRAWER = """\
# drawer-open: Take hold of the drawer handle and pull the drawer open.
def drawer_open(robot):
    # The gripper has to come from above.
    if check("the robot's gripper is not vertically aligned with the drawer handle"):
        robot.place("the gripper above the drawer handle")
    if check("Is gripper open and above drawer handle?"):
        # Down, then hold on.
        # Both in one.
        robot.lower("gripper around drawer handle")
    if check('the gripper is closed'):
        robot.pull_back('')
"""
HEAD = 'def push(robot):\n    if check("the gripper is open"):\n        robot.push("the puck")\n'


def read_table(file):
    """Return the content of a TOML file beside the tests."""
    return tomllib.loads((Path(__file__).parent / file).read_text("utf-8"))


def plan(task="push", *pairs):
    return ConditionalPlan.from_pairs(task, pairs or [("the gripper is open", "push the puck")])


@st.composite
def queries(draw, task):
    texts = st.sampled_from(supported_queries(task))
    return parse_query(" and ".join(draw(st.lists(texts, min_size=1, max_size=3))), task)


verbs = st.from_regex(r"[A-Za-z][A-Za-z0-9_]{0,8}", fullmatch=True)
tricky = st.sampled_from(
    ['"', "'", "\\", '\\"', "\\n", "\\\\", "#", '"):', "robot.x()",
     "puck", "gripper", "the", "robot's", "box", "lid", "above", "an", "its", "and", "door's", "lock",
     "ß", "手", "🤖", "é", "\n", "\u2028", "\x85", "\x0b", "\t", "\ufeff"]
)  # fmt: skip
details = st.lists(tricky | st.text(max_size=6), max_size=8).map(" ".join) | st.text(max_size=30)
skills = st.builds("{} {}".format, verbs, details)
reasons = st.just("") | st.lists(tricky | st.text(max_size=8), max_size=6).map(" ".join)


@st.composite
def conditional_plans(draw, task=None):
    task = task or draw(st.sampled_from(MT50))
    steps = st.tuples(queries(task), skills, reasons).map(lambda fields: PlanStep(*fields))
    return ConditionalPlan(task, tuple(draw(st.lists(steps, min_size=1, max_size=4))))
