"""The replay buffer over a dataset: which rows, which label, what a transform adds."""

from __future__ import annotations

import pytest
import torch
from torchrl.data import SliceSampler

from lw_torchrl.data import LanguageWorldExperienceReplay, TaskBalancedSampler, collect_demonstrations
from lw_torchrl.data.dataset import load_rows
from lw_torchrl.language.plan_files import load_plans
from lw_torchrl.language.query_program import QueryProgram
from lw_torchrl.transforms import QAFTransform

STEPS = 50


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Two failures, then successes at steps 36 and 48, of 50."""
    root = tmp_path_factory.mktemp("made") / "demos"
    made = collect_demonstrations(
        "reach", episodes_per_task=4, root=root, max_steps=STEPS, noise_scale=(0, 0.3), progress=False
    )
    assert {e.success for e in made.episodes} == {True, False}, "the tests want successes and failures"
    return made


@pytest.fixture(scope="module")
def rows(made):
    return load_rows(made)


@pytest.fixture(scope="module")
def plans():
    return load_plans("MT10")


@pytest.mark.parametrize("label", ["expert", "executed"])
@pytest.mark.parametrize("after", [0, 1, 5, 13, 20, 499])
def test_after_success_drops_exactly_the_later_rows(made, rows, label, after):
    kept, last = [], []
    for episode in made.episodes:
        for t in range(episode.length):
            hits = [h for h in range(episode.length) if rows["next", "success"][episode.start + h]]
            if not hits or t <= hits[0] + after:
                kept.append(episode.start + t)
                if t == episode.length - 1 or (hits and t == hits[0] + after):
                    last.append(episode.start + t)
    assert len(kept) < len(rows) or after > 13
    replay = LanguageWorldExperienceReplay(made.root, label=label, after_success=after)
    found, expected = replay[:], rows[torch.tensor(kept)]
    assert len(replay) == len(kept)
    assert torch.equal(found["observation"], expected["observation"])
    assert torch.equal(found["action"], expected["expert_action" if label == "expert" else "action"])
    if label == "executed":
        ends = torch.isin(torch.tensor(kept), torch.tensor(last))
        for key in ("done", "truncated"):
            assert torch.equal(found["next", key].flatten(), ends)
        assert not found["next", "terminated"].any()
        for key in ("observation", "reward_dense", "success"):
            assert torch.equal(found["next", key], expected["next", key])
        assert torch.equal(found["next", "reward"], expected["next", "success"].float())


@pytest.mark.parametrize("label", ["expert", "executed"])
def test_a_transform_answers_the_plans_queries(made, plans, label):
    replay = LanguageWorldExperienceReplay(made.root, batch_size=32, label=label, transform=QAFTransform(plans))
    batch = replay.sample()
    program = QueryProgram({task: [step.condition for step in plan.steps] for task, plan in plans.items()})
    assert batch["qaf"].dtype == torch.bool
    assert batch["qaf"].shape == (32, plans.num_steps)
    assert torch.equal(batch["qaf"], program(batch["observation"], batch["task_id"]))
    assert (("next", "qaf") in batch.keys(True)) == (label == "executed")
    if label == "executed":
        following = program(batch["next", "observation"], batch["next", "task_id"])
        assert torch.equal(batch["next", "qaf"], following)


def test_the_generator_fixes_the_batches(made):
    def batches(seed):
        generator = torch.Generator().manual_seed(seed)
        replay = LanguageWorldExperienceReplay(made.root, batch_size=16, generator=generator)
        return torch.cat([replay.sample()["observation"] for _ in range(3)])

    assert torch.equal(batches(0), batches(0))
    assert not torch.equal(batches(0), batches(1))


def test_the_generator_is_that_of_a_sampler_that_comes_later(made):
    def drawn(later):
        generator = torch.Generator().manual_seed(0)
        replay = LanguageWorldExperienceReplay(
            made.root, batch_size=16, generator=generator, sampler=None if later else TaskBalancedSampler()
        )
        if later:
            replay.set_sampler(TaskBalancedSampler())
        return replay.sample()["index"]

    assert torch.equal(drawn(later=True), drawn(later=False))


def test_torchrls_own_slice_sampler_finds_the_episodes(made):
    sampler = SliceSampler(slice_len=10, traj_key=("collector", "traj_ids"))
    batch = LanguageWorldExperienceReplay(made.root, batch_size=40, sampler=sampler, label="executed").sample()
    slices = batch.reshape(4, 10)
    assert (slices["episode"] == slices["episode"][:, :1]).all()
    assert torch.equal(slices["observation"][:, 1:], slices["next", "observation"][:, :-1])


def test_it_knows_its_tasks_and_where_it_lies(made):
    replay = LanguageWorldExperienceReplay(made.root, sampler=TaskBalancedSampler(), batch_size=7)
    assert replay.tasks == ("reach",)
    assert replay.data_path_root == made.root
    assert replay.data_path == made.root / "data"
    assert replay.demonstrations == made
    assert len(replay.sample()) == 7
