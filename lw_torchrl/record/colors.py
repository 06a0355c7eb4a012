"""The colours of a recording."""

from __future__ import annotations

Color = tuple[int, ...]

BACKGROUND = (24, 27, 33)
TRUE, FALSE = (70, 170, 105), (52, 56, 64)
STEEL, GOLD, GREEN, WHITE = (205, 210, 220), (255, 200, 60), (90, 220, 120), (255, 255, 255)
SERIES_COLORS: tuple[Color, ...] = (
    (80, 170, 255),
    (255, 150, 70),
    (110, 215, 120),
    (225, 110, 225),
    (240, 215, 80),
    (100, 215, 215),
    (250, 110, 120),
    (170, 150, 250),
)


def step_color(step: int) -> Color:
    """The colour of a step of a plan, counted from 0, wherever it is shown."""
    return SERIES_COLORS[step % len(SERIES_COLORS)]
