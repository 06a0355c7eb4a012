"""The figure of success by steps: what is drawn, and what is refused."""

import numpy as np
import pytest

from lw_torchrl.evaluation import plot_learning_curves

CURVES = {
    "push": {"td3": [[(5000, 0.2), (10000, 0.9)], [(5000, 0.4), (10000, 0.5)]], "ppo": [[(5000, 0.1), (10000, 0.1)]]},
    "reach": {"td3": [[(5000, 1.0), (10000, 1.0)]]},
}


def test_a_panel_for_each_task_and_a_line_for_each_method(tmp_path):
    figure = plot_learning_curves(CURVES, tmp_path / "curves.png", starts={"push": 0.3}, title="online")
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")
    push, reach = figure.axes
    assert (push.get_title(), reach.get_title(), figure.get_suptitle()) == ("push", "reach", "online")
    td3, ppo, start = push.get_lines()
    np.testing.assert_allclose(td3.get_xydata(), [[5, 0.3], [10, 0.7]])
    np.testing.assert_allclose(ppo.get_ydata(), [0.1, 0.1])
    np.testing.assert_allclose(start.get_ydata(), [0.3, 0.3])
    low, high = (
        push.collections[0].get_paths()[0].vertices[:, 1].min(),
        push.collections[0].get_paths()[0].vertices[:, 1].max(),
    )
    assert (low, high) == (0.2, 0.9)
    assert reach.get_lines()[0].get_color() == td3.get_color()
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["td3 (2 seeds)", "ppo (1 seed)", "start, evaluated", "td3 (1 seed)"]


def test_many_tasks_take_several_rows():
    figure = plot_learning_curves({f"task {k}": CURVES["reach"] for k in range(5)})
    assert [axes.get_visible() for axes in figure.axes] == [True] * 5 + [False] * 3


def test_what_cannot_be_drawn_is_refused(tmp_path):
    with pytest.raises(ValueError, match="curves must hold at least one task"):
        plot_learning_curves({})
    with pytest.raises(ValueError, match=r"curves\['push'\]\['td3'\] must have the same steps in all seeds"):
        plot_learning_curves({"push": {"td3": [[(1, 0.5)], [(2, 0.5)]]}})
    with pytest.raises(ValueError, match="path must end in"):
        plot_learning_curves(CURVES, tmp_path / "curves.txt")
