"""Answers in the kinds of mess that models make of a prompt, written by hand, and what is to be read from them."""

from typing import NamedTuple


class Answer(NamedTuple):
    task: str
    format: str
    text: str
    steps: list[tuple[str, str]]  # the conditions as queries, and the skills as they are written
    notes: list[str] = []  # parts of notes, each with its line
    reason: str = ""


GRIPPER = "the robot's gripper is"

ANSWERS = {
    "goes on from the prompt, then invents tasks, and is cut off": Answer(
        "drawer-open",
        "basic_py",
        """
    if check("the robot's gripper is not above drawer handle"):
        robot.place("gripper above drawer handle")
    if check("the robot's gripper is around drawer handle"):
        robot.pull("drawer handle toward the robot")

# cupboard-open: open the cupboard
def cupboard_open(robot):
    if check("the robot's gripper is not above the drawer handle"):
        robot.place("gripper above knob")
    if check("the robot's gri""",
        [
            (f"{GRIPPER} not above the drawer handle", "place the gripper above the drawer handle"),
            (f"{GRIPPER} around the drawer handle", "pull the drawer handle toward the robot"),
        ],
        ["line 8: 'cupboard-open' was not asked for; 1 step left out"],
    ),
    "lost the first line's indentation": Answer(
        "push",
        "basic_py",
        """if check("the gripper is open"):
        robot.lower("gripper around puck")
    if check("the gripper is closed"):
        robot.move("puck to goal")""",
        [(f"{GRIPPER} open", "lower the gripper around the puck"), (f"{GRIPPER} closed", "move the puck to goal")],
    ),
    "has no indentation at all": Answer(
        "push",
        "basic_py",
        """def push(robot):
if check("gripper open"):
robot.hold("puck")
if check("gripper closed"):
robot.move("puck")""",
        [(f"{GRIPPER} open", "hold the puck"), (f"{GRIPPER} closed", "move the puck")],
    ),
    "nests conditions": Answer(
        "push",
        "chain_py",
        """def push(robot):
    # First come near.
    if check("the gripper is near the puck"):
        if check("the gripper is open"):
            robot.close("gripper around puck")
        elif check("the puck is touching the table"):
            robot.lift("puck")
        else:
            robot.move("puck to the target location")
""",
        [
            (f"{GRIPPER} near the puck and {GRIPPER} open", "close the gripper around the puck"),
            (f"{GRIPPER} near the puck and the puck is touching the table", "lift the puck"),
        ],
        ["line 6: 'elif' is taken for 'if'", "line 8: an 'else' says no condition"],
    ),
    "asks in other ways": Answer(
        "push",
        "basic_py",
        """def Push(robot):
    if check("gripper open") and not check("gripper near puck"): robot.place("gripper above puck")
    if not check("gripper open and gripper near puck"):
        robot.wait()
    if check("gripper open") or check("gripper closed"):
        robot.wait()
    while (check(
        "the gripper is near the puck "
        'and the gripper is closed'
    )):
        robot.move(
            "puck to the target location",
            speed=0.5,
        )
    if robot.holding("puck"):
        robot.wait()
    robot.wave("hello")
""",
        [
            (f"{GRIPPER} open and {GRIPPER} not near the puck", "place the gripper above the puck"),
            (f"{GRIPPER} near the puck and {GRIPPER} closed", "move the puck to the target location"),
        ],
        [
            "line 3: the opposite of several conditions",
            "line 5: an 'or' of conditions",
            'line 15: asks nothing by check("...")',
            "line 17: a skill without a condition is left out",
        ],
    ),
    "argues, and goes on with code": Answer(
        "reach",
        "basic_py_md",
        """Certainly! Here's a function. It first checks whether the robot is there; when it is not, it moves.

```python
# reach: Move the gripper to the target in the air.
def reach(robot):
    \"\"\"Reach the target.\"\"\"
    # Is this right? If check("x") were used, robot.fly("away") might be better.
    if check("the robot's gripper is not near the reach target"):
        robot.move("the gripper to the reach target")  # quickly
    return True
```

Note that the robot should never stop. When you are done, run it:

```python
import robot
reach(robot.Robot())
```
[eod] [code]
def reach(robot):
    if check("the gripper is open"):
        robot.go("home")
    if check("the gripper is closed"):
        robot.go("home")
""",
        [(f"{GRIPPER} not near the reach target", "move the gripper to the reach target")],
        ["line 10: is no part of a plan: 'return True'", "line 19: the answer ends here"],
    ),
    "has no closing fence, and two versions": Answer(
        "reach",
        "chain_py_md",
        """```
def reach(robot):
    if check("the gripper is near the reach target"):
        robot.hold("gripper at the reach target")
```
Better:
```
def reach(robot):
    # Far away.
    if check("the gripper is not near the reach target"):
        robot.move("gripper to the reach target")
    if check("the gripper is near the reach target"):
        robot.hold("gripper at the reach target")""",
        [
            (f"{GRIPPER} not near the reach target", "move the gripper to the reach target"),
            (f"{GRIPPER} near the reach target", "hold the gripper at the reach target"),
        ],
        ["line 2: 'reach' is another version; 1 step left out"],
    ),
    "prints its plan": Answer(
        "push",
        "basic_py",
        """print("def push(robot):")
print("    if check(\\"gripper open\\"):")
print("        robot.move(\\"puck\\")")
""",
        [(f"{GRIPPER} open", "move the puck")],
    ),
    "states to reach, named by the steps": Answer(
        "push",
        "goal_py",
        """    # Steps:
    #  1. Place the gripper above the puck
    #  2. Take the puck
    # Come from above.
    if check("the robot's gripper is not above puck"):
        robot.move_gripper("above puck", open_gripper=True)
    if check("the robot's gripper is above puck"):
        robot.move_gripper("near puck", close_gripper=True)
""",
        [
            (f"{GRIPPER} not above the puck", "Place the gripper above the puck"),
            (f"{GRIPPER} above the puck", "Take the puck"),
        ],
    ),
    "states to reach, without names": Answer(
        "push",
        "goal_md",
        """To push it, the robot acts as follows:
Steps:  1. Come near
- When the gripper is not above the puck, move the robot's gripper until the robot's gripper is above the puck
- If the gripper is above the puck, move gripper until it is near the puck and the gripper is closed.
- When the gripper is closed, move the robot's gripper until peace is reached everywhere on earth
""",
        [
            (f"{GRIPPER} not above the puck", "move the gripper above the puck"),
            (f"{GRIPPER} above the puck", "move the gripper near the puck and close the gripper"),
            (f"{GRIPPER} closed", "move peace reached everywhere on earth"),
        ],
        ["line 5: no query is near enough to the goal"],
    ),
    "prose with reasons that look like rules": Answer(
        "drawer-open",
        "chain_md",
        """The task `drawer-open`: pull it open.
    Steps:  1. Come over it  2. Pull
    If the gripper is far away, the robot should come closer.
    - When the robot's gripper is not above the drawer handle, the robot should place gripper above drawer handle.
    When the gripper is there, pull.
    - Finally, when the robot's gripper is around drawer handle, it should pull the drawer handle toward the robot.
    - Repeat until done.
    - When it is open, the task is complete.

The task `drawer-shut` is to undo it:
    - When the robot's gripper is not above the drawer handle, the robot should cry.
""",
        [
            (f"{GRIPPER} not above the drawer handle", "place the gripper above the drawer handle"),
            (f"{GRIPPER} around the drawer handle", "pull the drawer handle toward the robot"),
        ],
        [
            "line 7: a rule without a condition or a skill is left out",
            "line 8: a rule without a condition or a skill is left out",
            "line 10: 'drawer-shut' was not asked for; 1 step left out",
        ],
    ),
    "prose as a list of strings": Answer(
        "reach",
        "basic_md",
        """ANSWERS = {
  "push":
    "When the gripper is open, the robot should fly.",
  "reach":
    "<b>When the gripper is not near the reach target, the robot should move the gripper to the reach target.</b>",
}""",
        [(f"{GRIPPER} not near the reach target", "move the gripper to the reach target")],
        ["line 2: 'push' was not asked for; 1 step left out"],
    ),
    "Python where prose was asked for": Answer(
        "push",
        "basic_md",
        'def push(robot):\n    if check("gripper open"):\n        robot.push("puck")',
        [(f"{GRIPPER} open", "push the puck")],
        ["line 2: is written in another format than was asked for"],
    ),
    "words outside the language": Answer(
        "push",
        "basic_py",
        """    if check("the robot's gripper is holding onto the puck and the puk is at the goal"):
        robot.release("puck")
    if check("the moon is made of green cheese"):
        robot.place("gripper above puck")
    if check("the gripper is open"):
        robot.("puck")
""",
        [(f"{GRIPPER} around the puck and the puck is near the target location", "release the puck")],
        [
            "line 1: the condition",
            "line 3: a step is left out: no query is near enough",
            "line 6: is cut off",
        ],
    ),
    "a refusal": Answer("push", "basic_py", "I'm sorry, I can't see the function `push`.", [], [], "it has no steps"),
    "nothing": Answer("push", "basic_md", " \n", [], [], "the text is empty"),
    "only another task": Answer(
        "push", "basic_py", 'def shove(robot):\n  if check("gripper open"):\n    robot.push("puck")', [], [],
        "it has no steps for push, but some for 'shove'",
    ),
    "nothing that could be mapped": Answer(
        "push", "basic_py", '    if check("the moon is made of green cheese"):\n        robot.eat("it")', [], [],
        "none of its 1 step for push could be kept; of the first: no query is near enough",
    ),
}  # fmt: skip
