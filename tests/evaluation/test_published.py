"""The published numbers we ship: complete, in range, and with the means that were published."""

from __future__ import annotations

import re

import pytest

import lw_torchrl as lw
from lw_torchrl.evaluation import published, published_curves, published_plans

MEANS = {
    ("zero-shot", "PCBC"): (0.258, 0.4035),
    ("zero-shot", "DC"): (0.28875, 0.381),
    ("few-shot", "PCBC"): (0.39325, 0.631),
    ("few-shot", "DC"): (0.3395, 0.43675),
    ("one-shot", "PCBC"): (0.54575, 0.68),
    ("one-shot", "DC"): (0.539, 0.539),
}


@pytest.mark.parametrize(("setting", "method"), MEANS)
def test_they_are_complete_and_average_to_the_published_means(setting, method):
    last, best = (published(setting, method, which) for which in ("last", "best"))
    assert tuple(last) == tuple(best) == lw.MT50
    assert all(0 <= rate <= 1 for rate in (*last.values(), *best.values()))
    # 4 seeds of 20 episodes
    assert all(rate * 80 == pytest.approx(round(rate * 80)) for rate in (*last.values(), *best.values()))
    assert all(last[task] <= best[task] for task in lw.MT50)
    means = sum(last.values()) / 50, sum(best.values()) / 50
    assert means == pytest.approx(MEANS[setting, method], abs=1e-9)


def test_the_default_is_the_last_evaluation_of_pcbc():
    assert published("few-shot") == published("few-shot", "PCBC", "last")


@pytest.mark.parametrize("format", lw.PLAN_FORMATS)
@pytest.mark.parametrize("model", ["PaLM 2", "GPT-3.5", "GPT-3"])
def test_the_generated_plans_rates(model, format):
    found = published_plans(model, format)
    assert tuple(found) == lw.MT50
    assert all(len(rates) == 5 and all(0 <= rate <= 1 for rate in rates) for rates in found.values())


def test_palm_2_solves_what_it_solved():
    mean = sum(sum(rates) / 5 for rates in published_plans("PaLM 2").values()) / 50
    assert mean == pytest.approx(0.32952)


def test_curves_are_labelled_for_what_they_are():
    curves = published_curves("zero-shot", ["PCBC", "DC"])
    assert list(curves) == [
        "PCBC published, best of the last 10 evaluations",
        "PCBC published, last",
        "DC published, best of the last 10 evaluations",
        "DC published, last",
    ]
    assert curves["DC published, last"] == published("zero-shot", "DC", "last")
    assert curves["PCBC published, best of the last 10 evaluations"] == published("zero-shot", which="best")
    assert published_curves("zero-shot", "DC") == {k: v for k, v in curves.items() if k.startswith("DC")}


def test_what_a_caller_changes_stays_his():
    published("few-shot")["reach"] = 2.0
    assert published("few-shot")["reach"] <= 1.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("fewshot",), "setting must be one of 'zero-shot', 'few-shot', 'one-shot', got 'fewshot'; did you mean"),
        (("few-shot", "pcbc"), "method must be one of 'PCBC', 'DC', got 'pcbc'"),
        (("few-shot", "DC", "best-of-10"), "which must be one of 'last', 'best', got 'best-of-10'"),
    ],
)
def test_what_was_not_published_is_refused(arguments, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        published(*arguments)


def test_another_model_is_refused():
    with pytest.raises(ValueError, match=r"model must be one of 'PaLM 2', 'GPT-3.5', 'GPT-3', got 'GPT-4'"):
        published_plans("GPT-4")
    with pytest.raises(ValueError, match=r"format must be one of 'basic_py', .*, got 'py'"):
        published_plans(format="py")
