"""n steps ahead: TorchRL's own numbers, flags that belong to the observation beside them, no episode crossed."""

from __future__ import annotations

from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from streams import Stream, own_rows
from tensordict import TensorDict
from torchrl.data import MultiStep
from torchrl.envs import MultiStepTransform
from torchrl.modules import ValueOperator
from torchrl.objectives.value import TD0Estimator

from lw_torchrl.data import JoinedStorage, LanguageWorldExperienceReplay, collect_demonstrations
from lw_torchrl.data.growing import GrowingStorage

steps = st.integers(2, 7)
gammas = st.sampled_from([0.5, 0.97, 1.0])


def torchrls(rows, n_steps, gamma, flags=()):
    """What TorchRL's MultiStep makes of trajectories, each (T,) rows, by itself."""
    oracle = MultiStep(gamma, n_steps)
    oracle.done_keys = flags  # or else done and terminated would stay those of the first step
    return torch.cat([oracle(one.unsqueeze(0))[0] for one in rows])


def trajectories(rows):
    ids = rows["collector", "traj_ids"]
    cuts = [0, *((ids[1:] != ids[:-1]).nonzero().flatten() + 1).tolist(), len(ids)]
    return [rows[a:b] for a, b in pairwise(cuts)]


def check(found, expected):
    for key in (*(("next", key) for key in ("observation", "done", "terminated", "truncated")), "steps_to_next_obs"):
        assert torch.equal(found[key], expected[key]), key
    torch.testing.assert_close(found["next", "reward"], expected["next", "reward"], rtol=5e-7, atol=1e-6)
    for key in ("observation", "action"):
        assert torch.equal(found[key], expected[key])


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(1, 9), min_size=1, max_size=5), steps, gammas, st.booleans())
def test_they_are_torchrls(lengths, n_steps, gamma, two_parts):
    rows = own_rows(lengths)
    parts = [rows, own_rows(lengths[::-1], first=500.0)] if two_parts else [rows]
    expected = torch.cat([torchrls(trajectories(part), n_steps, gamma) for part in parts])
    storage = JoinedStorage(parts, n_steps=n_steps, gamma=gamma)
    check(storage[:], expected)
    assert torch.equal(storage.column("steps_to_next_obs"), expected["steps_to_next_obs"])
    assert torch.equal(storage.column(("next", "observation")), expected["next", "observation"])
    some = torch.tensor([[0, -1]])
    assert (storage[some] == storage[:][some]).all()


def test_rows_that_are_chosen_do_not_look_over_those_that_are_not():
    rows = own_rows([6])
    found = JoinedStorage([rows], [torch.tensor([0, 1, 3, 4])], n_steps=4, gamma=0.5)[:]
    assert found["steps_to_next_obs"].tolist() == [2, 1, 2, 1]
    assert torch.equal(found["next", "observation"], rows["next", "observation"][[1, 1, 4, 4]])


@settings(max_examples=20, deadline=None)
@given(st.lists(st.integers(1, 6), min_size=1, max_size=6), st.integers(1, 3), steps, st.integers(0, 99))
def test_rows_that_come_look_as_far_as_torchrls_transform_once_the_others_are_there(sizes, envs, n_steps, seed):
    stream, storage = Stream(0, envs, seed), GrowingStorage([own_rows([3])], grow=200, n_steps=n_steps, gamma=0.9)
    batches = [stream.batch(size) for size in sizes]
    oracle = MultiStepTransform(n_steps, 0.9, done_keys=[])
    expected = []
    for batch in batches:
        storage.extend(batch)
        if (out := oracle.inv(batch.clone())) is not None:
            expected.append(out.reshape(-1))
    rows = storage[3:]
    check(rows, torch.cat([torchrls([one], n_steps, 0.9) for one in separate(batches)])[order(batches, rows)])
    if expected:
        late = torch.cat(expected)
        place = {x: k for k, x in enumerate(rows["observation"][:, 0].tolist())}
        check(rows[[place[x] for x in late["observation"][:, 0].tolist()]], late)


def separate(batches):
    """The trajectories of one collector's batches."""
    return [one for row in torch.cat(batches, 1) for one in trajectories(row)]


def order(batches, rows):
    """Where the storage's rows are among those of ``separate``."""
    place = {x: k for k, x in enumerate(torch.cat(separate(batches))["observation"][:, 0].tolist())}
    return [place[x] for x in rows["observation"][:, 0].tolist()]


def test_torchrls_own_flags_would_bootstrap_from_the_end():
    """Why done and terminated go with the observation, and why TorchRL's transform is refused."""
    rows = own_rows([4])
    rows["next", "terminated"][-1], rows["next", "truncated"][-1] = True, False
    theirs = MultiStep(0.9, 3)(rows.unsqueeze(0))[0]
    assert torch.equal(theirs["next", "observation"][1], rows["next", "observation"][3])
    assert not theirs["next", "terminated"][1]
    ours = JoinedStorage([rows], n_steps=3, gamma=0.9)[:]
    assert ours["next", "terminated"].flatten().tolist() == [False, True, True, True]


def test_a_value_estimator_discounts_by_the_steps():
    rows = own_rows([5])
    found = JoinedStorage([rows], n_steps=3, gamma=0.9)[:]
    value = ValueOperator(torch.nn.Linear(2, 1), in_keys=["observation"])
    target = TD0Estimator(gamma=0.9, value_network=value).value_estimate(found)
    after = value.module(found["next", "observation"])
    expected = found["next", "reward"] + 0.9 ** torch.tensor([[3.0], [3.0], [3.0], [2.0], [1.0]]) * after
    torch.testing.assert_close(target, expected.detach())


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    root = tmp_path_factory.mktemp("made") / "demos"
    collect_demonstrations("reach", episodes_per_task=3, root=root, max_steps=50, noise_scale=(0.2,), progress=False)
    return root


@pytest.mark.parametrize("after", [None, 4])
def test_of_a_dataset_they_end_with_the_episode_and_where_it_is_cut(root, after):
    options = dict(label="executed", reward="dense", after_success=after)
    plain = LanguageWorldExperienceReplay(root, **options)[:]
    found = LanguageWorldExperienceReplay(root, n_steps=5, gamma=0.99, **options)[:]
    check(found, torchrls(trajectories(plain), 5, 0.99))
    assert found["next", "done"].sum() == 15
    assert torch.equal(found["task_id"], found["next", "task_id"])


def test_n_steps_need_a_discount_and_executed_actions(root):
    with pytest.raises(ValueError, match="n_steps=3 needs gamma"):
        LanguageWorldExperienceReplay(root, label="executed", n_steps=3)
    with pytest.raises(ValueError, match="n_steps, grow and terminate_on_success need label='executed', got 'expert'"):
        LanguageWorldExperienceReplay(root, n_steps=3, gamma=0.9)


def test_columns_that_it_needs_are_named():
    with pytest.raises(ValueError, match="n_steps=2 needs the columns next/reward, next/done, collector/traj_ids"):
        JoinedStorage([TensorDict({"x": torch.arange(3)}, [3])], n_steps=2, gamma=0.9)
