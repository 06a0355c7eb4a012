"""Relations of your own: distances and coordinates of two positions, compared with thresholds in metres.

lw-torchrl query reach "Is the gripper far from the reach target?" --import my_relation
lw-torchrl check reach.plan --import my_relation
lw-torchrl evaluate scripted --tasks reach --plans reach.plan --episodes 2 --import my_relation
"""

from lw_torchrl.language.relations import RELATIONS, Comparison

RELATIONS["far from"] = (Comparison("xyz", ">", 0.3),)  # the length of all three
RELATIONS["beside"] = (  # all must hold: closer than 10 cm on the table's plane, and about as high
    Comparison("xy", "<", 0.1),
    Comparison("z", "<", 0.05, length=False),  # one coordinate, with its sign
    Comparison("z", ">", -0.05, length=False),
)
