"""A StateQueryEvaluator learns what the query answering function answers, from what is not held out."""

from __future__ import annotations

import json

import pytest
import torch
from small_training import assert_same, flat

import lw_torchrl as lw
from lw_torchrl.evaluation import score_evaluator

PLANS = lw.load_plans("MT10")
SMALL = lw.training.QueryEvaluatorConfig(steps=12, batch_size=64, checkpoint_every=5)
PARTS = ("training", "states", "queries", "tasks")


@pytest.fixture(scope="module")
def replay(tmp_path_factory):
    root = tmp_path_factory.mktemp("states")
    for who in ("scripted", "random"):
        lw.collect_demonstrations(
            ["drawer-open", "push", "reach"],
            episodes_per_task=8,
            root=root / who,
            policy=who,
            max_steps=50,
            progress=False,
        )
    return lw.LanguageWorldExperienceReplay([root / "scripted", root / "random"], label="executed")


def make(seed=0, **options):
    torch.manual_seed(seed)
    return lw.StateQueryEvaluator(PLANS, **{"width": 16, "depth": 1, **options})


def make_trainer(replay, path=None, *, config=SMALL, **options):
    data = lw.training.LabelledQueries(replay, config)
    return lw.training.QueryEvaluatorTrainer(make(**options), data, config, checkpoint=path, progress=False)


def everything(trainer):
    return flat({"weights": dict(trainer.evaluator.state_dict()), "optimizer": trainer.optimizer.state_dict()})


# ---- what is trained, and what is not


def test_what_is_held_out_is_nowhere_trained(replay):
    config = lw.training.QueryEvaluatorConfig(held_out_tasks=("reach",), held_out_pairs=0.3, seed=3)
    data = lw.training.LabelledQueries(replay, config)
    assert (data.tasks, data.held_out_tasks) == (("drawer-open", "push"), ("reach",))
    assert all(data.parts[part] for part in PARTS)
    assert {asked.task.name for asked in data.parts["tasks"]} == {"reach"}
    trained = {(asked.task.name, clause) for asked in data.parts["training"] for clause in asked.clauses}
    pairs = {tuple(sorted((clause.subject, clause.object or ""))) for _, clause in trained}
    held = {tuple(sorted((c.subject, c.object or ""))) for asked in data.parts["queries"] for c in asked.clauses}
    assert held == {*data.held_out_pairs}
    assert held.isdisjoint(pairs)
    assert {c.predicate for asked in data.parts["queries"] for c in asked.clauses} <= {c.predicate for _, c in trained}
    seen = {tuple(row) for asked in data.parts["training"] for row in asked.observation.tolist()}
    for part in ("states", "queries"):
        for asked in data.parts[part]:
            assert not any(tuple(row) in seen for row in asked.observation.tolist())


def test_labels_are_the_query_answering_functions(replay):
    data = lw.training.LabelledQueries(replay, SMALL)
    asked = data.parts["training"][0]
    program = lw.QueryProgram({asked.task: [str(clause) for clause in asked.clauses]})
    ids = torch.full((len(asked.observation),), lw.task_id(asked.task.name))
    assert torch.equal(asked.truth, program(asked.observation, ids))
    assert 0 < asked.truth.float().mean() < 1


def test_the_seed_says_what_is_held_out(replay):
    def drawn(seed):
        found = lw.training.LabelledQueries(replay, lw.training.QueryEvaluatorConfig(held_out_tasks=1, seed=seed))
        return found.held_out_tasks, found.held_out_pairs

    assert drawn(0) == drawn(0)
    assert len({drawn(seed) for seed in range(6)}) > 1
    none = lw.training.LabelledQueries(
        replay, lw.training.QueryEvaluatorConfig(held_out_pairs=0.0, held_out_states=0.0)
    )
    assert not any(none.parts[part] for part in PARTS[1:])


def test_a_minibatch_has_equally_many_of_each_predicate_and_truth(replay):
    queries = make_trainer(replay).minibatches[0].source
    groups = len(queries.sizes)
    batch = queries.sample(groups * 7)
    kinds = torch.stack((batch["clauses", "predicate"][:, 0], batch["truth"][:, 0].long()), -1)
    _, counts = kinds.unique(dim=0, return_counts=True)
    assert len(counts) == groups >= 24
    assert (counts == 7).all()


# ---- learning


def test_two_tasks_are_learned_quickly(replay):
    config = lw.training.QueryEvaluatorConfig(steps=400, batch_size=512, learning_rate=1e-2, held_out_tasks=("reach",))
    data = lw.training.LabelledQueries(replay, config)
    evaluator = make(width=64, depth=2)
    before = score_evaluator(evaluator, data).parts["states"].balanced_accuracy()
    lw.training.QueryEvaluatorTrainer(evaluator, data, config, progress=False).train()
    found = score_evaluator(evaluator, data).parts
    assert before < 0.7
    assert found["states"].accuracy() > 0.98
    assert found["states"].balanced_accuracy() > 0.98
    assert found["queries"].accuracy() > 0.9
    assert found["tasks"].accuracy() > 0.87


def test_a_report_counts_every_answer_once(replay, tmp_path):
    data = lw.training.LabelledQueries(replay, SMALL)
    report = score_evaluator(make(), data)
    asked = data.parts["states"]
    states = report.parts["states"]
    assert states.answers == sum(one.truth.numel() for one in asked)
    assert sum(true for _, true in states.asked.values()) == int(sum(one.truth.sum() for one in asked))
    assert states.balanced_accuracy(states.worst[0]) == min(map(states.balanced_accuracy, states.asked))
    report.save(tmp_path / "report.json")
    assert json.loads((tmp_path / "report.json").read_text())["parts"]["states"]["accuracy"] == states.accuracy()
    assert "held-out queries" in report.table()


# ---- files


def test_training_that_was_stopped_goes_on_to_the_bit(replay, tmp_path):
    whole = make_trainer(replay)
    loss = whole.train()
    first = make_trainer(replay, tmp_path / "e.safetensors")
    for _ in range(7):
        first.step()
    first.save()
    second = make_trainer(replay, tmp_path / "e.safetensors", seed=1)
    assert second.steps == 7
    assert second.train() == pytest.approx(loss, abs=1.0)
    assert_same(everything(second), everything(whole))
    again = make_trainer(replay, tmp_path / "e.safetensors")
    assert again.steps == SMALL.steps
    loaded = lw.training.load_evaluator(tmp_path / "e.safetensors", PLANS)
    assert not loaded.training
    assert_same(flat(dict(loaded.state_dict())), flat(dict(whole.evaluator.state_dict())))


def test_another_training_does_not_go_on(replay, tmp_path):
    make_trainer(replay, tmp_path / "e.safetensors").train()
    with pytest.raises(ValueError, match=r"its training differs in .*batch_size"):
        make_trainer(
            replay, tmp_path / "e.safetensors", config=lw.training.QueryEvaluatorConfig(steps=12, batch_size=32)
        )
    with pytest.raises(ValueError, match=r"its evaluator differs in .*width"):
        make_trainer(replay, tmp_path / "e.safetensors", width=17)


def test_it_is_loaded_for_any_plans(tmp_path):
    evaluator = make()
    lw.training.save_evaluator(evaluator, tmp_path / "e.safetensors", note="mine")
    other = lw.training.load_evaluator(tmp_path / "e.safetensors", lw.load_plans("MT50"))
    assert other.plans.fingerprint == lw.load_plans("MT50").fingerprint
    assert torch.equal(other.network.trunk[0].weight, evaluator.network.trunk[0].weight)


def test_what_is_no_evaluators_file_is_refused(tmp_path):
    path = tmp_path / "e.safetensors"
    with pytest.raises(FileNotFoundError, match="train-evaluator` writes one"):
        lw.training.load_evaluator(path, PLANS)
    lw.save_actor(lw.PlanConditionedActor(PLANS), path)
    with pytest.raises(ValueError, match=r"must be an evaluator of version 2, got format 'lw_torchrl\.actor'"):
        lw.training.load_evaluator(path, PLANS)
    path.write_bytes(b"PK")
    with pytest.raises(ValueError, match=r"is damaged or not a \.safetensors file"):
        lw.training.load_evaluator(path, PLANS)

    with pytest.raises(TypeError, match="evaluator must be a QueryEvaluator"):
        lw.training.save_evaluator(torch.nn.Linear(1, 1), path)


# ---- refusals


def test_what_cannot_be_is_named(replay):
    with pytest.raises(ValueError, match="held_out_tasks must leave tasks to train on, got 3 of 3"):
        lw.training.LabelledQueries(replay, lw.training.QueryEvaluatorConfig(held_out_tasks=3))
    with pytest.raises(ValueError, match=r"held_out_tasks must be one of .*'reach'.*got 'reech'; did you mean 'reach'"):
        lw.training.LabelledQueries(replay, lw.training.QueryEvaluatorConfig(held_out_tasks=("reech",)))
    with pytest.raises(ValueError, match="held_out_states must leave a tenth"):
        lw.training.QueryEvaluatorConfig(held_out_states=0.95)
    with pytest.raises(ValueError, match="tasks must have all tasks of the rows"):
        lw.training.LabelledQueries(replay, SMALL, [lw.TASKS["reach"]])
    data = lw.training.LabelledQueries(replay, SMALL)
    with pytest.raises(TypeError, match="evaluator must be a ClauseEvaluator, got QueryEvaluator"):
        lw.training.QueryEvaluatorTrainer(lw.QueryEvaluator(PLANS), data)
    with pytest.raises(ValueError, match="must hold out states, queries or tasks"):
        score_evaluator(
            make(),
            lw.training.LabelledQueries(
                replay, lw.training.QueryEvaluatorConfig(held_out_pairs=0.0, held_out_states=0.0)
            ),
        )
