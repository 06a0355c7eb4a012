"""The layout that the viewer opens with: a page for each episode, and the tabs of metrics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from lw_torchrl.record.timelines import EPISODE_TIMELINE, METRIC_TIMELINE

if TYPE_CHECKING:
    import rerun.blueprint as rrb


def make_blueprint(episodes: Sequence[Any], others: Sequence[Any]) -> rrb.Blueprint:
    """The whole layout; the time panel plays episodes at Meta-World's 80 steps a second."""
    import rerun.blueprint as rrb

    timeline = EPISODE_TIMELINE if episodes else METRIC_TIMELINE
    return rrb.Blueprint(
        rrb.Tabs(*episodes, *others),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=timeline, fps=80.0, play_state="paused", loop_mode="all"),
        auto_views=False,
    )
