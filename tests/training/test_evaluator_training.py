"""Query evaluators learn the exact answers to queries, from states and from pictures."""

import json
from dataclasses import replace

import pytest
import torch
from pictures import why_no_pictures
from small_training import CONFIG, assert_same, flat, make_actor
from tensordict.nn import TensorDictSequential

import lw_torchrl as lw
from lw_torchrl.evaluation import score_evaluator
from lw_torchrl.evaluation.evaluator_score import clause_logits

PLANS = lw.load_plans("MT10")
SMALL = lw.training.QueryEvaluatorConfig(steps=12, batch_size=64, checkpoint_every=5)
PARTS = ("training", "states", "queries", "tasks")


@pytest.fixture(scope="module")
def replay(tmp_path_factory):
    root = tmp_path_factory.mktemp("states")
    for who in ("scripted", "random"):
        options = {"episodes_per_task": 8, "max_steps": 50, "progress": False}
        lw.collect_demonstrations(["drawer-open", "push", "reach"], root=root / who, policy=who, **options)
    return lw.LanguageWorldExperienceReplay([root / "scripted", root / "random"], label="executed")


def make(seed=0, **options):
    torch.manual_seed(seed)
    return lw.modules.StateQueryEvaluator(PLANS, **{"width": 16, "depth": 1, **options})


def make_trainer(replay, path=None, *, config=SMALL, **options):
    data = lw.training.LabelledQueries(replay, config)
    return lw.training.QueryEvaluatorTrainer(make(**options), data, config, checkpoint=path, progress=False)


def everything(trainer):
    return flat({"weights": dict(trainer.evaluator.state_dict()), "optimizer": trainer.optimizer.state_dict()})


def test_held_out_data_are_not_in_the_training_data(replay):
    config = lw.training.QueryEvaluatorConfig(held_out_tasks=("reach",), held_out_pairs=0.3, seed=3)
    parts = (data := lw.training.LabelledQueries(replay, config)).parts
    assert (data.tasks, data.held_out_tasks) == (("drawer-open", "push"), ("reach",))
    assert all(parts[part] for part in PARTS)
    assert {queries.task.name for queries in parts["tasks"]} == {"reach"}
    clauses = {part: [clause for each in parts[part] for clause in each.clauses] for part in PARTS}
    pairs = {part: {tuple(sorted((each.subject, each.object or ""))) for each in clauses[part]} for part in PARTS}
    assert pairs["queries"] == {*data.held_out_pairs}
    assert pairs["queries"].isdisjoint(pairs["training"])
    predicates = {part: {clause.predicate for clause in clauses[part]} for part in PARTS}
    assert predicates["queries"] <= predicates["training"]
    states = {part: {tuple(row) for each in parts[part] for row in each.observation.tolist()} for part in PARTS}
    assert states["training"].isdisjoint(states["states"] | states["queries"])


def test_nothing_need_be_held_out(replay):
    config = lw.training.QueryEvaluatorConfig(held_out_pairs=0.0, held_out_states=0.0)
    data = lw.training.LabelledQueries(replay, config)
    assert not any(data.parts[part] for part in PARTS[1:])
    with pytest.raises(ValueError, match="data must hold out"):
        score_evaluator(make(), data)


def test_a_minibatch_has_equally_many_pairs_of_each_predicate_and_truth(replay):
    queries = make_trainer(replay).minibatches[0].source
    groups = len(queries.sizes)
    batch = queries.rows(queries.draw(groups * 7))
    kinds = torch.stack((batch["clauses", "predicate"][:, 0], batch["truth"][:, 0].long()), -1)
    _, counts = kinds.unique(dim=0, return_counts=True)
    assert len(counts) == groups >= 24
    assert (counts == 7).all()


def test_two_tasks_are_learned_quickly(replay):
    config = lw.training.QueryEvaluatorConfig(steps=400, batch_size=512, learning_rate=1e-2, held_out_tasks=("reach",))
    data = lw.training.LabelledQueries(replay, config)
    evaluator = make(width=64, depth=2)
    before = score_evaluator(evaluator, data).parts["states"].balanced_accuracy()
    lw.training.QueryEvaluatorTrainer(evaluator, data, config, progress=False).train()
    scores = score_evaluator(evaluator, data).parts
    assert before < 0.7
    assert min(scores["states"].accuracy(), scores["states"].balanced_accuracy()) > 0.98
    assert scores["queries"].accuracy() > 0.9
    assert scores["tasks"].accuracy() > 0.87


def test_a_score_counts_every_answer_once(replay, tmp_path):
    data = lw.training.LabelledQueries(replay, SMALL)
    score = score_evaluator(make(), data)
    part, states = data.parts["states"], score.parts["states"]
    assert states.answers == sum(queries.truth.numel() for queries in part)
    assert sum(true for _, true in states.total.values()) == int(sum(queries.truth.sum() for queries in part))
    assert states.balanced_accuracy(states.worst[0]) == min(map(states.balanced_accuracy, states.total))
    score.save(tmp_path / "score.json")
    assert json.loads((tmp_path / "score.json").read_text())["parts"]["states"]["accuracy"] == states.accuracy()
    assert "held-out queries" in score.table()


def test_interrupted_training_resumes_bit_for_bit_and_another_one_is_refused(replay, tmp_path):
    path = tmp_path / "e.safetensors"
    whole = make_trainer(replay)
    whole.train()
    make_trainer(replay, path).train(until=7)
    second = make_trainer(replay, path, seed=1)
    assert second.steps == 7
    second.train()
    assert_same(everything(second), everything(whole))
    assert make_trainer(replay, path).steps == SMALL.steps
    loaded = lw.training.load_evaluator(path, PLANS)
    assert not loaded.training
    assert_same(flat(dict(loaded.state_dict())), flat(dict(whole.evaluator.state_dict())))
    wider = lw.training.load_evaluator(path, lw.load_plans("MT50"))
    assert wider.plans == lw.load_plans("MT50")
    assert torch.equal(wider.network.trunk[0].weight, loaded.network.trunk[0].weight)
    with pytest.raises(ValueError, match=r"its training differs in .*batch_size"):
        make_trainer(replay, path, config=replace(SMALL, batch_size=32))
    with pytest.raises(ValueError, match=r"its evaluator differs in .*width"):
        make_trainer(replay, path, width=17)


# ---- imitation that also trains an evaluator


def agreement(trainer):
    rows = trainer.replay[:]
    exact = lw.QAFTransform(PLANS)(rows.select("observation", "task_id"))["qaf"]
    with torch.no_grad():
        return ((trainer.actor[0].logits_of(rows) > 0) == exact).float().mean()


def test_the_anchor_keeps_the_answers_exact(demos):
    replay = lw.LanguageWorldExperienceReplay(demos, sampler=lw.TaskBalancedSampler())

    def trainer(weight):
        config = replace(CONFIG, qaf_anchor=weight, steps=60)
        return lw.BehavioralCloningTrainer(TensorDictSequential(make(), make_actor()), replay, config, progress=False)

    free, anchored = trainer(0.0), trainer(1.0)
    before = agreement(free)
    free.train()
    anchored.train()
    assert agreement(anchored) > max(before + 0.1, agreement(free) + 0.1, 0.9)


TWO = lw.Plans({task: PLANS[task] for task in ("drawer-open", "reach")})
PICTURES = {"cameras": ("corner", "corner3"), "height": 24, "width": 24}
SEEING = lw.training.ImageQueryEvaluatorConfig(steps=6, batch_size=8, checkpoint_every=2, held_out_pairs=0.0)


def with_pictures(root, **options):
    if missing := why_no_pictures():
        pytest.skip(missing)
    lw.collect_demonstrations([*TWO], root=root, progress=False, **options)
    lw.data.add_pictures(root, **PICTURES, every=5, progress=False)
    replay = lw.LanguageWorldExperienceReplay(root, label="executed")
    replay.add_column("pixels", lw.data.load_pictures(replay, **PICTURES, every=5))
    return replay


@pytest.mark.slow
def test_it_learns_positions_and_answers(tmp_path):
    seen = with_pictures(tmp_path / "demos", episodes_per_task=3, max_steps=60)
    config = replace(SEEING, steps=900, batch_size=16, learning_rate=3e-3, held_out_states=0.0)
    data = lw.training.LabelledQueries(seen, config)

    def right(evaluator):
        with torch.no_grad():
            answers = [clause_logits(evaluator, queries) for queries in data.parts["training"]]
        return torch.stack([((logits > 0) == truth).float().mean() for logits, truth in answers])

    torch.manual_seed(0)
    evaluator = lw.modules.ImageQueryEvaluator(TWO, **PICTURES, hidden=16, depth=1)
    before = right(evaluator)
    lw.training.QueryEvaluatorTrainer(evaluator, data, config, progress=False).train()
    assert (right(evaluator) > before + 0.15).all()
    for queries in data.parts["training"]:
        with torch.no_grad():
            places, _ = evaluator.network.places(queries.pixels, evaluator.network.names.weight)
        hand, true = places[:, evaluator.names.index("robot's gripper"), :3], queries.observation[:, :3]
        assert (hand - true).norm(dim=-1).median() < 0.6 * (true.mean(0) - true).norm(dim=-1).median()


def test_only_states_with_their_own_picture_are_used(tmp_path):
    seen = with_pictures(tmp_path / "demos", episodes_per_task=2, max_steps=40)
    data = lw.training.LabelledQueries(seen, SEEING)
    states = sum(len(queries.observation) for part in ("training", "states") for queries in data.parts[part])
    assert states == 2 * 2 * 8  # tasks, episodes, 40 steps at 5 apart
    sparse = lw.LanguageWorldExperienceReplay(seen.root, label="executed")
    pictures = lw.data.load_pictures(sparse, **PICTURES, every=5)
    sparse.add_column("pixels", pictures[torch.arange(len(sparse)) // 20 * 20])
    with pytest.raises(ValueError, match="every"):
        lw.training.LabelledQueries(sparse, SEEING)
