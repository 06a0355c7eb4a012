"""MethodComparison: methods side by side, with tables that a reader can check by hand."""

import pytest

from lw_torchrl.evaluation import MethodComparison, mean_difference, probability_of_improvement, summarize_rates

A = summarize_rates({"push": [0.9, 0.7], "assembly": [0.5, 0.3]})
B = summarize_rates({"assembly": [0.4, 0.4], "push": [0.2, 0.2]})
PUBLISHED = {"published, last": {"push": 0.8, "assembly": 0.1, "reach": 1.0}}


def test_pairs_match_tasks_by_name():
    (pair,) = MethodComparison({"a": A, "b": B}).pairs
    rates = [[0.9, 0.5], [0.7, 0.3]], [[0.2, 0.4], [0.2, 0.4]]
    assert pair.methods == ("a", "b")
    assert pair.difference == mean_difference(*rates)
    assert pair.difference.value == pytest.approx(0.3)
    assert pair.improvement == probability_of_improvement(*rates)
    less = MethodComparison({"a": A, "b": B}, confidence=0.5).pairs[0]
    assert less.difference == mean_difference(*rates, confidence=0.5) != pair.difference


def test_tables():
    comparison = MethodComparison({"a": A, "b": B}, PUBLISHED)
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in comparison.per_task().splitlines()]
    assert rows[0] == ["task", "a", "b", "published, last"]
    assert rows[2:] == [["push", "0.80 (0.70-0.90)", "0.20", "0.80"], ["assembly", "0.40 (0.30-0.50)", "0.40", "0.10"]]
    lines = comparison.headline().splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[:5]]
    assert rows[0] == ["method", "mean", "IQM", "tasks >= 0.8, of 2", "seeds", "mean of the 1 outside MT10"]
    assert rows[2][3:] == ["1", "0.700, 0.500", "0.400"]
    assert rows[4] == ["published, last", "0.450", "", "1", "", "0.100"]
    assert lines[-1].startswith("a - b: 0.300 [")


def test_one_method_alone_has_no_pairs():
    comparison = MethodComparison({"a": summarize_rates({"push": [0.9]})})
    assert comparison.pairs == []
    assert comparison.headline().count("\n") == 2
    assert "outside" not in comparison.headline()
    assert comparison.to_json()["pairs"] == []


def test_what_it_refuses():
    with pytest.raises(ValueError, match="at least one method"):
        MethodComparison({})
    with pytest.raises(ValueError, match=r"'a' and 'c' do not share the tasks \['assembly'\]"):
        MethodComparison({"a": A, "c": summarize_rates({"push": [0.1, 0.2]})})
