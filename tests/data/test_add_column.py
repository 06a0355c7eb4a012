"""Columns of one's own beside the rows: in every batch, at the right row, and refused where they would mislead."""

from __future__ import annotations

import pytest
import torch
from collecting import collect
from torchrl.data import RandomSampler

import lw_torchrl as lw
from lw_torchrl.data import CoLearningSampler, TaskBalancedSampler

VARIANTS = {
    "one": lambda a, b: dict(root=a),
    "experts": lambda a, b: dict(root=a, label="expert"),
    "cut": lambda a, b: dict(root=a, after_success=2),
    "joined": lambda a, b: dict(root=[a, b]),
    "chosen": lambda a, b: dict(root=[a, b], episodes=[{"reach": [2, 0]}, {"push": [1]}]),
    "n steps": lambda a, b: dict(root=[a, b], n_steps=3, gamma=0.9),
    "on a device": lambda a, b: dict(root=a, device="cpu"),
}


@pytest.fixture(scope="module")
def roots(tmp_path_factory):
    root = tmp_path_factory.mktemp("columns")
    return collect(root / "a").root, collect(root / "b", seed=6).root


def opened(roots, variant, **options):
    return lw.LanguageWorldExperienceReplay(**{"label": "executed", **VARIANTS[variant](*roots), **options})


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("sampler", [RandomSampler, TaskBalancedSampler])
def test_batches_hold_each_rows_own_value(roots, variant, sampler):
    replay = opened(roots, variant, batch_size=12, sampler=sampler())
    before = replay[:]
    own = torch.arange(len(replay), dtype=torch.float32)[:, None]
    replay.add_column("advantage", own)
    replay.add_column("pair", torch.stack([own, -own], -1))
    assert torch.equal(replay[:]["advantage"], own)
    assert (replay[:].exclude("advantage", "pair") == before).all()
    assert torch.equal(replay[5]["advantage"], own[5])
    for _ in range(4):
        batch = replay.sample()
        assert torch.equal(batch["advantage"], own[batch["index"]])
        assert torch.equal(batch["pair"], torch.stack([own, -own], -1)[batch["index"]])
        assert torch.equal(batch["observation"], before["observation"][batch["index"]])


@pytest.mark.parametrize("variant", ["one", "joined"])
def test_a_copy_is_kept_without_its_graph(roots, variant):
    replay = opened(roots, variant, batch_size=4)
    values = torch.zeros(len(replay), 1, requires_grad=True)
    replay.add_column("advantage", values * 2)
    assert not replay.sample()["advantage"].requires_grad
    plain = torch.zeros(len(replay), 1)
    replay.add_column("other", plain)
    plain.fill_(7)
    assert (replay[:]["other"] == 0).all()


@pytest.mark.parametrize("variant", ["one", "joined", "n steps"])
def test_what_is_drawn_and_the_samplers_state_stay_as_they_were(roots, variant, tmp_path):
    def make():
        return opened(
            roots, variant, batch_size=8, sampler=TaskBalancedSampler(), generator=torch.Generator().manual_seed(3)
        )

    plain, columned = make(), make()
    first = plain.sample(), columned.sample()
    columned.add_column("advantage", torch.arange(len(columned)).float())
    assert (first[0] == first[1]).all()
    state = columned.state_dict()
    assert set(state["_sampler"]) == set(plain.state_dict()["_sampler"])
    expected = [plain.sample()["index"] for _ in range(5)]
    assert all(torch.equal(columned.sample()["index"], index) for index in expected)
    again = make()
    again.add_column("advantage", torch.arange(len(again)).float())
    again.load_state_dict(state)
    for index in expected:
        batch = again.sample()
        assert torch.equal(batch["index"], index)
        assert torch.equal(batch["advantage"], index.float())


def test_beside_a_transform_and_a_co_learning_sampler(roots):
    plans = lw.load_plans("MT10")
    replay = opened(roots, "joined", batch_size=8, sampler=CoLearningSampler("push"), transform=lw.QAFTransform(plans))
    for name in ("qaf", "qaf_plan", "is_target", "is_demonstration", "index", "action", "next", "behaviour"):
        with pytest.raises(ValueError, match=f"name must be new, samples have '{name}' already"):
            replay.add_column(name, torch.zeros(len(replay)))
    replay.add_column("advantage", torch.arange(len(replay)))
    batch = replay.sample()
    assert torch.equal(batch["advantage"], batch["index"])


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("a", lambda n: torch.zeros(n - 1), r"values must have 84 rows, got a tensor of shape \(83,\)"),
        ("a", lambda n: torch.full((n,), torch.nan), "values of 'a' must be finite"),
        ("observation", lambda n: torch.zeros(n, 39), "name must be new"),
    ],
)
def test_wrong_columns_are_refused(roots, name, values, message):
    replay = opened(roots, "one")
    before = replay[:]
    with pytest.raises(ValueError, match=message):
        replay.add_column(name, values(len(replay)))
    assert (replay[:] == before).all()


def test_values_of_other_rows_are_refused(roots):
    replay, ahead = opened(roots, "joined"), opened(roots, "n steps")
    replay.add_column("advantage", torch.zeros(len(ahead), 1), of=ahead)
    turned = lw.LanguageWorldExperienceReplay(list(roots[::-1]), label="executed")
    assert len(turned) == len(replay)
    with pytest.raises(ValueError, match="of must show the rows of this buffer, in their order"):
        replay.add_column("other", torch.zeros(len(turned), 1), of=turned)
