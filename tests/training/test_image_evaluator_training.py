"""An ImageQueryEvaluator learns from pictures what the query answering function answers, and finds the things."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from pictures import why_no_pictures
from small_training import make_actor
from tensordict.nn import TensorDictSequential

import lw_torchrl as lw

PLANS = lw.Plans({task: lw.load_plans("MT10")[task] for task in ("drawer-open", "reach")})
PICTURES = {"cameras": ("corner", "corner3"), "height": 24, "width": 24}
CONFIG = lw.training.ImageQueryEvaluatorConfig(steps=6, batch_size=8, checkpoint_every=2, held_out_pairs=0.0)


@pytest.fixture(scope="module", autouse=True)
def _needs_open_gl():
    if missing := why_no_pictures():
        pytest.skip(missing)


@pytest.fixture(scope="module")
def replay(tmp_path_factory):
    root = tmp_path_factory.mktemp("states") / "demos"
    lw.collect_demonstrations([*PLANS], episodes_per_task=3, root=root, max_steps=60, progress=False)
    lw.data.add_pictures(root, **PICTURES, every=5, progress=False)
    replay = lw.LanguageWorldExperienceReplay(root, label="executed")
    replay.add_column("pixels", lw.data.load_pictures(replay, **PICTURES, every=5))
    return replay


def letters(texts):
    return torch.tensor([[float(text.count(letter)) for letter in "abdefghilnoprstuw"] for text in texts])


def make(seed=0, **options):
    torch.manual_seed(seed)
    return lw.modules.ImageQueryEvaluator(PLANS, **PICTURES, hidden=16, depth=1, **options)


def make_trainer(replay, path=None, config=CONFIG, **options):
    data = lw.training.LabelledQueries(replay, config)
    return lw.training.ImageQueryEvaluatorTrainer(make(**options), data, config, checkpoint=path, progress=False)


def test_a_policy_that_sees_is_tuned_and_goes_on_bit_for_bit(replay, tmp_path):
    def train(path, stop=None):
        torch.manual_seed(1)
        actor = TensorDictSequential(make(answers="hard"), make_actor(plans=PLANS))
        config = lw.BehavioralCloningConfig(steps=6, batch_size=8, qaf_anchor=0.1, checkpoint_every=2)
        buffer = lw.LanguageWorldExperienceReplay(replay.root, sampler=lw.TaskBalancedSampler())
        buffer.add_column("pixels", lw.data.load_pictures(buffer, **PICTURES, every=5))
        trainer = lw.BehavioralCloningTrainer(actor, buffer, config, checkpoint=path, progress=False)
        for _ in range(stop or 0):
            trainer.step()
        trainer.save() if stop else trainer.train()
        return lw.load_actor(path).state_dict()

    whole = train(tmp_path / "whole.safetensors")
    begun = train(tmp_path / "begun.safetensors", stop=4)
    eye = next(name for name in whole if "network.key" in name)
    assert not torch.equal(begun[eye], whole[eye])
    resumed = train(tmp_path / "begun.safetensors")
    for name, value in whole.items():
        assert torch.equal(resumed[name], value), name


@pytest.mark.slow
def test_it_learns_where_things_are_and_what_holds(replay):
    config = replace(CONFIG, steps=900, batch_size=16, learning_rate=3e-3, held_out_states=0.0)
    data = lw.training.LabelledQueries(replay, config)

    def right(evaluator):
        found = []
        for asked in data.parts["training"]:
            clauses = evaluator.code([(asked.task, clause) for clause in asked.clauses])
            every = clauses.pick(torch.arange(len(asked.clauses)).expand(len(asked.pixels), -1))
            with torch.no_grad():
                found.append(((evaluator.network(asked.pixels, every) > 0) == asked.truth).float().mean())
        return torch.stack(found)

    evaluator = make()
    before = right(evaluator)
    lw.training.ImageQueryEvaluatorTrainer(evaluator, data, config, progress=False).train()
    assert (right(evaluator) > before + 0.15).all()
    for asked in data.parts["training"]:
        with torch.no_grad():
            places, _ = evaluator.network.places(asked.pixels, evaluator.network.names.weight)
        hand, true = places[:, evaluator.names.index("robot's gripper"), :3], asked.observation[:, :3]
        assert (hand - true).norm(dim=-1).median() < 0.6 * (true.mean(0) - true).norm(dim=-1).median()


def test_only_states_with_a_picture_of_their_own_are_asked(replay):
    data = lw.training.LabelledQueries(replay, CONFIG)
    states = sum(len(asked.observation) for part in ("training", "states") for asked in data.parts[part])
    assert states == 2 * 3 * 12  # tasks, episodes, 60 steps at 5 apart
    held = lw.LanguageWorldExperienceReplay(replay.root, label="executed")
    pictures = lw.data.load_pictures(held, **PICTURES, every=5)
    held.add_column("pixels", pictures[torch.arange(len(held)) // 20 * 20])
    with pytest.raises(ValueError, match=r"every must be as many steps as the pictures are apart"):
        lw.training.LabelledQueries(held, CONFIG)


def test_what_does_not_fit_is_named(replay, tmp_path):
    plain = lw.LanguageWorldExperienceReplay(replay.root, label="executed")
    with pytest.raises(ValueError, match=r"data must have the column 'pixels'.*lw\.data\.add_pictures"):
        make_trainer(plain)
    with pytest.raises(TypeError, match=r"config must be an ImageQueryEvaluatorConfig"):
        lw.training.ImageQueryEvaluatorTrainer(
            make(), lw.training.LabelledQueries(replay, CONFIG), lw.training.QueryEvaluatorConfig(every=5)
        )
    with pytest.raises(TypeError, match=r"evaluator must be of class ImageQueryEvaluator"):
        lw.training.ImageQueryEvaluatorTrainer(
            lw.StateQueryEvaluator(PLANS, width=8), lw.training.LabelledQueries(replay, CONFIG), CONFIG, progress=False
        )
    with pytest.raises(ValueError, match=r"pixels must be uint8 of shape"):
        lw.training.ImageQueryEvaluatorTrainer(
            lw.modules.ImageQueryEvaluator(PLANS, cameras="corner", height=24, width=24),
            lw.training.LabelledQueries(replay, CONFIG),
            CONFIG,
        )
    with pytest.raises(ValueError, match=r"position_weight must be"):
        lw.training.ImageQueryEvaluatorConfig(position_weight=-1.0)
