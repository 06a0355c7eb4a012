"""The noise on executed actions: where a plan goes on and where it does not."""

from itertools import pairwise

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict

from lw_torchrl.training.algorithms import TD3Config
from lw_torchrl.training.online import Exploration, longest_standstill

ROWS, PATIENCE = 3, 4
CONFIG = TD3Config(frames=60, rows=ROWS, exploration=0.1, stuck_exploration=0.5, gripper_exploration=0.5)


def state(*truth):
    """The truth of two conditions in each row, numbers from 0 to 3."""
    numbers = torch.tensor(truth)
    return TensorDict({"qaf": torch.stack([numbers % 2, numbers // 2], -1).bool()}, [ROWS])


@pytest.fixture
def exploration():
    found = Exploration(CONFIG, PATIENCE)
    found._drawn = torch.ones(ROWS, 4)
    return found


def test_where_a_plan_goes_on_it_is_small_and_half_for_the_gripper(exploration):
    for number in range(20):
        torch.testing.assert_close(
            exploration.noise(state(*[number % 2] * ROWS)), torch.tensor([[0.1, 0.1, 0.1, 0.05]] * ROWS)
        )


def test_it_grows_on_the_hand_where_no_truth_changes(exploration):
    found = [exploration.noise(state(0, number % 2, 0)) for number in range(9)]
    stuck = [0.1] * 5 + [0.3] + [0.5] * 3
    torch.testing.assert_close(torch.stack([one[0, 0] for one in found]), torch.tensor(stuck))
    assert {round(float(one[0, 3]), 6) for one in found} == {0.05}
    assert {round(float(one[1, 0]), 6) for one in found} == {0.1}


def test_a_row_whose_episode_ends_begins_anew(exploration):
    for _ in range(8):
        before = exploration.noise(state(0, 0, 0))
    exploration.note(torch.tensor([True, False, False]))
    after = exploration.noise(state(0, 0, 0))
    assert before[:, 0].tolist() == pytest.approx([0.5] * 3)
    assert after[:, 0].tolist() == pytest.approx([0.1, 0.5, 0.5])
    for _ in range(PATIENCE):
        assert exploration.noise(state(0, 0, 0))[0, 0] == pytest.approx(0.1)
    assert exploration.noise(state(0, 0, 0))[0, 0] == pytest.approx(0.3)


def test_without_queries_or_patience_nobody_is_stuck():
    for patience, seen in ((PATIENCE, TensorDict({}, [ROWS])), (0, state(0, 0, 0))):
        exploration = Exploration(CONFIG, patience)
        exploration._drawn = torch.ones(ROWS, 4)
        for _ in range(20):
            assert exploration.noise(seen)[:, 0].tolist() == pytest.approx([0.1] * ROWS)


def test_what_is_drawn_stays_until_the_next():
    torch.manual_seed(0)
    exploration = Exploration(CONFIG, 0)
    exploration.draw()
    first = exploration.noise(state(0, 0, 0))
    assert torch.equal(first, exploration.noise(state(1, 1, 1)))
    assert first.abs().sum() > 0
    exploration.draw()
    assert not torch.equal(first, exploration.noise(state(1, 1, 1)))


@given(st.lists(st.tuples(st.integers(0, 2), st.integers(0, 3)), min_size=1, max_size=40))
def test_the_longest_standstill_is_the_longest_run(rows):
    ids, truth = (torch.tensor(column) for column in zip(*rows, strict=True))
    qaf = torch.stack([truth % 2, truth // 2], -1).bool()
    longest, here = 1, 1
    for before, now in pairwise(rows):
        here = here + 1 if before == now else 1
        longest = max(longest, here)
    found = TensorDict({"collector": {"traj_ids": ids}, "qaf": qaf}, [len(rows)])
    assert longest_standstill(found) == longest
    assert longest_standstill(found.exclude("qaf")) == 0
