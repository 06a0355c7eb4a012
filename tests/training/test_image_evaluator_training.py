"""An ImageQueryEvaluator learns from pictures to answer queries and to locate objects."""

from dataclasses import replace

import pytest
import torch
from pictures import why_no_pictures

import lw_torchrl as lw
from lw_torchrl.evaluation.evaluator_score import clause_logits

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


@pytest.mark.slow
def test_it_learns_positions_and_answers(replay):
    config = replace(CONFIG, steps=900, batch_size=16, learning_rate=3e-3, held_out_states=0.0)
    data = lw.training.LabelledQueries(replay, config)

    def right(evaluator):
        with torch.no_grad():
            answers = [clause_logits(evaluator, queries) for queries in data.parts["training"]]
        return torch.stack([((logits > 0) == truth).float().mean() for logits, truth in answers])

    torch.manual_seed(0)
    evaluator = lw.modules.ImageQueryEvaluator(PLANS, **PICTURES, hidden=16, depth=1)
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
