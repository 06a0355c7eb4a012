"""Custom relations: compare the distance between two positions, or its coordinates, with thresholds in metres.

lw-torchrl query reach "Is the gripper far from the reach target?" --import my_relation
lw-torchrl check reach.plan --import my_relation
lw-torchrl evaluate scripted --tasks reach --plans reach.plan --episodes 2 --import my_relation
"""

from lw_torchrl.language.relations import RELATIONS, Comparison

RELATIONS["far from"] = (Comparison("xyz", ">", 0.3),)  # the distance in 3-D
RELATIONS["beside"] = (  # all must hold: less than 10 cm apart horizontally, and at about the same height
    Comparison("xy", "<", 0.1),
    Comparison("z", "<", 0.05, length=False),  # the signed difference in z
    Comparison("z", ">", -0.05, length=False),
)
