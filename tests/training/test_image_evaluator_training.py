"""An ImageQueryEvaluator learns from pictures to answer queries and to locate objects."""

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


def make(seed=0, **options):
    torch.manual_seed(seed)
    return lw.modules.ImageQueryEvaluator(PLANS, **PICTURES, hidden=16, depth=1, **options)


@pytest.mark.slow
def test_a_policy_with_an_image_evaluator_resumes_bit_for_bit(replay, tmp_path):
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
    encoder = next(name for name in whole if "network.key" in name)
    assert not torch.equal(begun[encoder], whole[encoder])
    resumed = train(tmp_path / "begun.safetensors")
    for name, value in whole.items():
        assert torch.equal(resumed[name], value), name


@pytest.mark.slow
def test_it_learns_positions_and_answers(replay):
    config = replace(CONFIG, steps=900, batch_size=16, learning_rate=3e-3, held_out_states=0.0)
    data = lw.training.LabelledQueries(replay, config)

    def right(evaluator):
        rates = []
        for queries in data.parts["training"]:
            clauses = evaluator.code([(queries.task, clause) for clause in queries.clauses])
            every = clauses.pick(torch.arange(len(queries.clauses)).expand(len(queries.pixels), -1))
            with torch.no_grad():
                rates.append(((evaluator.network(queries.pixels, every) > 0) == queries.truth).float().mean())
        return torch.stack(rates)

    evaluator = make()
    before = right(evaluator)
    lw.training.QueryEvaluatorTrainer(evaluator, data, config, progress=False).train()
    assert (right(evaluator) > before + 0.15).all()
    for queries in data.parts["training"]:
        with torch.no_grad():
            places, _ = evaluator.network.places(queries.pixels, evaluator.network.names.weight)
        hand, true = places[:, evaluator.names.index("robot's gripper"), :3], queries.observation[:, :3]
        assert (hand - true).norm(dim=-1).median() < 0.6 * (true.mean(0) - true).norm(dim=-1).median()


def test_only_states_with_their_own_picture_are_used(replay):
    data = lw.training.LabelledQueries(replay, CONFIG)
    states = sum(len(queries.observation) for part in ("training", "states") for queries in data.parts[part])
    assert states == 2 * 3 * 12  # tasks, episodes, 60 steps at 5 apart
    sparse = lw.LanguageWorldExperienceReplay(replay.root, label="executed")
    pictures = lw.data.load_pictures(sparse, **PICTURES, every=5)
    sparse.add_column("pixels", pictures[torch.arange(len(sparse)) // 20 * 20])
    with pytest.raises(ValueError, match="every"):
        lw.training.LabelledQueries(sparse, CONFIG)
