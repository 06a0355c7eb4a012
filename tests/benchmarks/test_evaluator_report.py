"""Query evaluators: reports of calibration and of the drift of conditions, and plans that are programs."""

import json
from pathlib import Path

import pytest
import torch
from tensordict.nn import TensorDictSequential

import benchmarks
import lw_torchrl as lw
from benchmarks.evaluator_report import calibration_error, condition_drift, drift_table, reliability, write_report
from benchmarks.evaluators import load_plans
from lw_torchrl.transforms.qaf import plan_program

PLANS = lw.Plans({task: lw.load_plans("MT10")[task] for task in ("push", "reach")})


class Never(lw.QueryEvaluator):
    """Answers that no condition holds."""

    def logits(self, observation, task_id):
        return torch.full((*task_id.shape, self.plans.num_steps), -1.0)


@pytest.fixture(scope="module")
def replay(tmp_path_factory):
    root = tmp_path_factory.mktemp("report") / "demos"
    lw.collect_demonstrations(PLANS, episodes_per_task=3, root=root, max_steps=60, progress=False)
    return lw.LanguageWorldExperienceReplay(root, label="executed")


def test_report_has_the_calibration_of_every_answer(replay, tmp_path):
    data = lw.training.LabelledQueries(replay, lw.training.QueryEvaluatorConfig(held_out_tasks=("reach",)))
    evaluator = lw.modules.StateQueryEvaluator(PLANS, width=16, depth=1)
    bins = reliability(evaluator, data)
    for part, counts in bins.items():
        assert counts[:, 0].sum() == sum(asked.truth.numel() for asked in data.parts[part])
        assert counts[:, 2].sum() == sum(int(asked.truth.sum()) for asked in data.parts[part])
    table = write_report(evaluator, data, tmp_path / "report.json", most=2)
    parts = json.loads((tmp_path / "report.json").read_text())["parts"]
    assert parts["tasks"]["calibration_error"] == calibration_error(bins["tasks"])
    assert f"calibration error, held-out tasks: {calibration_error(bins['tasks']):.4f}" in table
    assert (tmp_path / "report.png").stat().st_size > 5000
    right = torch.tensor([[10.0, 2.0, 2.0], [10.0, 9.0, 7.0]], dtype=torch.float64)
    assert calibration_error(right) == pytest.approx(0.1)


def test_drift_compares_answers_with_the_exact_ones(replay):
    rows = replay[:]
    drifts = condition_drift(TensorDictSequential(Never(PLANS), lw.ScriptedSkillActor(PLANS)), rows)
    assert len(drifts) == len(PLANS["push"].steps) + len(PLANS["reach"].steps)
    assert [drift.agreement for drift in drifts] == sorted(drift.agreement for drift in drifts)
    truth = lw.QAFTransform(PLANS)(rows.clone())["qaf"]
    for drift in drifts:
        own = truth[rows["task_id"] == lw.task_id(drift.task)][:, drift.step]
        assert (drift.states, drift.believed, drift.exact) == (len(own), 0.0, pytest.approx(own.float().mean().item()))
        assert drift.agreement == pytest.approx(1.0 - drift.exact)
        assert drift.condition == str(PLANS[drift.task].steps[drift.step].condition)
    assert drifts[0].condition in drift_table(drifts, most=1)


TREES = load_plans(str(Path(benchmarks.__file__).parent / "data" / "tree_plans.toml"))


def test_programs_of_mt10_have_the_skills_of_the_shipped_plans_and_one_active_step():
    flat = lw.load_plans("MT10")
    assert {*TREES} == {*lw.MT10}
    for task, plan in TREES.items():
        assert {step.skill for step in plan.steps} == {step.skill for step in flat[task].steps}
    assert sum(" or " in str(step.condition) for plan in TREES.values() for step in plan.steps) == 7
    # In these states objects are a few centimetres apart, so most conditions are true in some of them.
    observation = 0.03 * torch.randn(4000, 39, generator=torch.Generator().manual_seed(0))
    answers = plan_program(TREES)(observation, torch.tensor([*flat.task_ids.values()]).repeat(400))
    assert (answers.sum(-1) == 1).all()  # "else" excludes all branches above it, and covers what they leave
