"""What the 13 relations mean, against the published formulas written out in plain Python."""

import math

import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from lw_torchrl.language.relations import PREDICATES, RELATIONS, TOUCHING, UNARY, Comparison, relation_holds

# Every relation as (value, sense, threshold) on d = first - second in metres, from the published semantics.
FORMULAS = {
    "near": lambda x, y, z: [(math.hypot(x, y, z), "<", 0.04)],
    "around": lambda x, y, z: [(math.hypot(x, y, z + 0.02), "<", 0.03)],
    "left of": lambda x, y, z: [(x, ">", 0.04)],
    "right of": lambda x, y, z: [(x, "<", -0.04)],
    "behind": lambda x, y, z: [(y, ">", 0.04), (math.hypot(x, z), "<", 0.04)],
    "in front of": lambda x, y, z: [(y, "<", -0.04), (math.hypot(x, z), "<", 0.04)],
    "above": lambda x, y, z: [(math.hypot(x, y), "<", 0.02), (z, ">", 0.0)],
    "below": lambda x, y, z: [(math.hypot(x, y), "<", 0.02), (z, "<", 0.0)],
    "vertically aligned with": lambda x, y, z: [(math.hypot(x, y), "<", 0.06)],
    "almost vertically aligned with": lambda x, y, z: [(math.hypot(x, y), "<", 0.12)],
    "mostly below": lambda x, y, z: [(z, "<", 0.23)],
    "horizontally aligned with": lambda x, y, z: [(math.hypot(y, z), "<", 0.03)],
    "forward aligned with": lambda x, y, z: [(math.hypot(x, z), "<", 0.03)],
}

relations = st.sampled_from(sorted(RELATIONS))
offsets = st.floats(-0.1, 0.1) | st.floats(-0.4, 0.4)
displacements = st.tuples(offsets, offsets, offsets)
positions = st.tuples(*(st.floats(-1, 1),) * 3)


def holds(relation, first, second, dtype=torch.float64):
    return relation_holds(relation, torch.tensor(first, dtype=dtype), torch.tensor(second, dtype=dtype)).item()


def moved(position, displacement):
    return tuple(p + d for p, d in zip(position, displacement, strict=True))


def test_the_relations_are_the_thirteen_published_ones():
    assert set(RELATIONS) == set(FORMULAS)
    assert set(UNARY) == {TOUCHING, "open", "closed"}
    assert set(PREDICATES) == set(RELATIONS) | set(UNARY)


@settings(deadline=None)
@given(relation=relations, second=positions, displacement=displacements)
def test_a_relation_is_its_formula(relation, second, displacement):
    first = moved(second, displacement)
    parts = FORMULAS[relation](*(a - b for a, b in zip(first, second, strict=True)))
    # Within rounding of a threshold either answer is right.
    assume(all(abs(value - threshold) > 1e-9 for value, _, threshold in parts))
    expected = all(value < threshold if sense == "<" else value > threshold for value, sense, threshold in parts)
    assert holds(relation, first, second) is expected


@pytest.mark.parametrize(
    ("relation", "inside", "outside"),
    [
        ("near", (0.02, 0.02, 0.027), (0.02, 0.02, 0.029)),
        ("around", (0.0, 0.0, -0.049), (0.0, 0.0, -0.051)),
        ("around", (0.0, 0.0, 0.009), (0.0, 0.0, 0.011)),
        ("around", (0.029, 0.0, -0.02), (0.031, 0.0, -0.02)),
        ("left of", (0.041, 9.0, 9.0), (0.039, 0.0, 0.0)),
        ("right of", (-0.041, 9.0, 9.0), (-0.039, 0.0, 0.0)),
        ("behind", (0.027, 0.041, 0.027), (0.029, 0.041, 0.029)),
        ("behind", (0.0, 0.041, 0.0), (0.0, 0.039, 0.0)),
        ("in front of", (0.027, -0.041, 0.027), (0.029, -0.041, 0.029)),
        ("in front of", (0.0, -0.041, 0.0), (0.0, -0.039, 0.0)),
        ("above", (0.013, 0.013, 0.001), (0.015, 0.015, 0.001)),
        ("above", (0.0, 0.0, 0.001), (0.0, 0.0, -0.001)),
        ("below", (0.013, 0.013, -0.001), (0.015, 0.015, -0.001)),
        ("below", (0.0, 0.0, -0.001), (0.0, 0.0, 0.001)),
        ("vertically aligned with", (0.042, 0.042, 9.0), (0.043, 0.043, 0.0)),
        ("almost vertically aligned with", (0.084, 0.084, 9.0), (0.085, 0.085, 0.0)),
        ("mostly below", (9.0, 9.0, 0.229), (0.0, 0.0, 0.231)),
        ("horizontally aligned with", (9.0, 0.021, 0.021), (0.0, 0.022, 0.022)),
        ("forward aligned with", (0.021, 9.0, 0.021), (0.022, 0.0, 0.022)),
    ],
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_each_threshold_lies_where_it_was_published(relation, inside, outside, dtype):
    assert holds(relation, inside, (0.0, 0.0, 0.0), dtype) is True
    assert holds(relation, outside, (0.0, 0.0, 0.0), dtype) is False


@pytest.mark.parametrize("relation", ["above", "below", "left of", "right of", "behind", "in front of"])
@settings(deadline=None)
@given(position=positions)
def test_a_strict_relation_does_not_hold_between_equal_places(relation, position):
    assert not holds(relation, position, position)


@pytest.mark.parametrize("pair", [("left of", "right of"), ("behind", "in front of"), ("above", "below")])
@settings(deadline=None)
@given(second=positions, displacement=displacements, dtype=st.sampled_from([torch.float32, torch.float64]))
def test_opposites_swap_and_never_hold_together(pair, second, displacement, dtype):
    first = moved(second, displacement)
    for one, other in (pair, pair[::-1]):
        forth = holds(one, first, second, dtype)
        assert forth == holds(other, second, first, dtype)
        assert not (forth and holds(one, second, first, dtype))
        assert not (forth and holds(other, first, second, dtype))


@pytest.mark.parametrize("relation", ["near", *(name for name in RELATIONS if name.endswith("aligned with"))])
@settings(deadline=None)
@given(first=positions, displacement=displacements)
def test_distances_are_symmetric(relation, first, displacement):
    second = moved(first, displacement)
    assert holds(relation, first, second) == holds(relation, second, first)
    assert holds(relation, first, first)


@settings(deadline=None)
@given(second=positions, displacement=displacements)
def test_what_implies_what(second, displacement):
    first = moved(second, displacement)
    true = {relation for relation in RELATIONS if holds(relation, first, second)}
    if "near" in true:
        assert {"vertically aligned with", "mostly below"} <= true
    if {"above", "below"} & true:
        assert "vertically aligned with" in true
    if "vertically aligned with" in true:
        assert "almost vertically aligned with" in true


def test_around_is_centred_two_centimetres_below_the_second():
    assert holds("around", (0.0, 0.0, -0.02), (0.0, 0.0, 0.0))
    assert not holds("around", (0.0, 0.0, 0.02), (0.0, 0.0, 0.0))


@pytest.mark.parametrize("relation", sorted(RELATIONS))
def test_positions_broadcast_over_any_batch(relation):
    generator = torch.Generator().manual_seed(0)
    first = torch.randn(7, 1, 3, generator=generator) * 0.05
    second = torch.randn(5, 3, generator=generator) * 0.05
    found = relation_holds(relation, first, second)
    assert found.shape == (7, 5)
    assert found.dtype == torch.bool
    expected = [[relation_holds(relation, a, b).item() for b in second] for a in first[:, 0]]
    assert found.tolist() == expected
    assert relation_holds(relation, torch.zeros(0, 3), second[0]).shape == (0,)


@pytest.mark.parametrize(
    ("name", "inside", "outside"),
    [
        (TOUCHING, [-1.0, 0.0, 0.02], [0.021, 1.0]),
        ("open", [0.751, 1.0], [0.75, 0.0]),
        ("closed", [0.75, 0.0], [0.751, 1.0]),
    ],
)
def test_the_unary_predicates_compare_one_number(name, inside, outside):
    (comparison,) = UNARY[name]
    for values, expected in ((inside, True), (outside, False)):
        for value in values:
            assert comparison.holds(torch.tensor([9.0, -9.0, value])).item() is expected


@settings(deadline=None)
@given(opening=st.floats(0, 1, width=32))
def test_open_and_closed_are_complements(opening):
    at = torch.tensor([0.0, 0.0, opening])
    assert UNARY["open"][0].holds(at).item() is not UNARY["closed"][0].holds(at).item()


def test_the_senses_differ_at_the_threshold_itself():
    at = torch.tensor([0.5, 0.0, 0.0])
    found = {sense: Comparison("x", sense, 0.5, length=False).holds(at).item() for sense in ("<", ">", "<=")}
    assert found == {"<": False, ">": False, "<=": True}


@pytest.mark.parametrize(
    ("relation", "near"), [("leftof", "left of"), ("Near", "near"), ("on top of", ""), ("open", ""), ("", "")]
)
def test_an_unknown_relation_names_the_nearest(relation, near):
    with pytest.raises(ValueError, match="relation must be one of") as caught:
        relation_holds(relation, torch.zeros(3), torch.zeros(3))
    assert repr(relation) in str(caught.value)
    if near:
        assert f"did you mean {near!r}" in str(caught.value)
