"""The simulators: Meta-World's own environments in a loop, and the fast engine with the same numbers."""

from collections.abc import Callable, Sequence
from typing import Any

from lw_torchrl._checks import check_choice
from lw_torchrl._registry import Registry, is_function
from lw_torchrl.suites.engine import Engine
from lw_torchrl.suites.metaworld.plain_engine import MetaWorldEngine
from lw_torchrl.suites.metaworld.vectorized.engine import VectorizedEngine

_SHIPPED = {"vectorized": VectorizedEngine, "metaworld": MetaWorldEngine}
ENGINES = Registry("engine", "lw_torchrl.engines", _SHIPPED, is_function)
"""Name to ``(row_tasks, *, reward, num_threads) -> Engine``."""


def make_engine(engine: str | Callable[..., Engine], row_tasks: Sequence[str], **options: Any) -> Engine:
    """The engine of that name, or what a callable of one's own gives, for rows of these tasks."""
    make: Callable[..., Engine] = engine if callable(engine) else ENGINES[check_choice("engine", engine, ENGINES)]
    return make(list(row_tasks), **options)
