"""Statistics over training seeds × tasks: means with bootstrap intervals, comparisons of methods, counts of tasks.

Every function takes success rates as an array (seeds, tasks): a row per training seed, a column per task. Intervals
are percentiles of a stratified bootstrap, as in rliable: seeds are drawn with replacement within each task, the tasks
stay. Two things to know when reading them:

- n seeds make them too narrow by about sqrt((n - 1) / n): in simulation (50 tasks, 20 episodes) the 95 % interval of
  the mean holds the truth in 0.87 of the cases for 3 seeds, 0.92 for 5, 0.93 for 10.
- Drawing seeds task by task takes them for independent, as where each task has its own policy. One policy for all
  tasks can be good or bad at all of them alike; then ``whole_seeds=True``, which draws a seed with all its tasks.

Source: Agarwal et al. 2021, 'Deep Reinforcement Learning at the Edge of the Statistical Precipice'.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lw_torchrl._checks import check_int

Array = NDArray[np.float64]
_CHUNK = 2_000_000  # resampled rates held in memory at once


@dataclass(frozen=True)
class Estimate:
    """A number and its interval.

    Attributes:
        value: the number, of the rates themselves.
        low, high: the ends of the interval; None where a single seed gives none.

    Example:
        >>> print(Estimate(0.5, 0.41, 0.6))
        0.500 [0.410, 0.600]
    """

    value: float
    low: float | None = None
    high: float | None = None

    def __str__(self) -> str:
        return f"{self.value:.3f}" + ("" if self.low is None else f" [{self.low:.3f}, {self.high:.3f}]")

    def to_json(self) -> dict[str, float | None]:
        """As a mapping of plain numbers."""
        return asdict(self)


def check_rates(argument: str, given: Any) -> Array:
    """``given`` as a float64 array (seeds, tasks) of rates in [0, 1].

    Raises:
        ValueError: another shape, no rates at all, or rates that are NaN or outside [0, 1].
        TypeError: what is no array of numbers.
    """
    try:
        rates = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise TypeError(f"{argument} must be an array of numbers, (seeds, tasks), got {given!r}") from error
    if rates.ndim != 2 or rates.size == 0:
        raise ValueError(f"{argument} must have shape (seeds, tasks), both at least 1, got {rates.shape}")
    if not ((rates >= 0) & (rates <= 1)).all():
        wrong = rates[~((rates >= 0) & (rates <= 1))][0]
        raise ValueError(f"{argument} must be rates in [0, 1], got {wrong}")
    return rates


def mean_rate(rates: ArrayLike, **options: Any) -> Estimate:
    """The mean success rate over seeds and tasks, with its interval.

    Args:
        rates: (seeds, tasks), in [0, 1].
        options: of the bootstrap, ``resamples`` (5000), ``seed`` (0), ``confidence`` (0.95); ``whole_seeds`` (False),
            draw a seed with all its tasks; ``resample_tasks`` (False), draw tasks with replacement too, for an
            interval over tasks like these instead of these.

    Raises:
        ValueError, TypeError: a wrong argument.

    Example:
        >>> print(mean_rate([[1.0, 0.2], [0.9, 0.3], [1.0, 0.1]]))
        0.583 [0.533, 0.633]
    """
    return _estimate(lambda x: x.mean((-2, -1)), [check_rates("rates", rates)], **options)


def interquartile_mean(rates: ArrayLike, **options: Any) -> Estimate:
    """The mean of the middle half of all seeds × tasks: a quarter is cut at each end.

    Args:
        rates: (seeds, tasks), in [0, 1].
        options: as for :func:`mean_rate`.

    Raises:
        ValueError, TypeError: a wrong argument.

    Example:
        >>> print(interquartile_mean([[1.0, 0.2], [0.9, 0.3], [1.0, 0.1]]))
        0.600 [0.525, 0.650]

    Source: Agarwal et al. 2021; the same as ``scipy.stats.trim_mean(rates, 0.25, axis=None)``.
    """
    return _estimate(_interquartile_mean, [check_rates("rates", rates)], **options)


def mean_difference(x: ArrayLike, y: ArrayLike, **options: Any) -> Estimate:
    """The mean over tasks of how much higher method X's rate is than Y's on the same task.

    Args:
        x, y: (seeds, tasks), in [0, 1]: the same tasks in the same order; the seeds may differ in number.
        options: as for :func:`mean_rate`. Tasks are paired: one drawn by ``resample_tasks`` is drawn for both.

    Raises:
        ValueError, TypeError: a wrong argument.

    Example:
        >>> print(mean_difference([[1.0, 0.5], [0.9, 0.4]], [[0.6, 0.3], [0.7, 0.3]]))
        0.225 [0.175, 0.275]
    """
    return _estimate(lambda a, b: a.mean((-2, -1)) - b.mean((-2, -1)), _pair(x, y), **options)


def probability_of_improvement(x: ArrayLike, y: ArrayLike, **options: Any) -> Estimate:
    """How likely a seed of method X beats one of Y on a task drawn at random; a tie counts half.

    Args:
        x, y: (seeds, tasks), in [0, 1]: the same tasks in the same order; the seeds may differ in number.
        options: as for :func:`mean_rate`.

    Raises:
        ValueError, TypeError: a wrong argument.

    Example:
        >>> probability_of_improvement([[1.0, 0.5], [0.9, 0.3]], [[0.6, 0.3], [0.7, 0.3]]).value
        0.875

    Source: Agarwal et al. 2021; the Mann-Whitney statistic of each task, averaged.
    """
    return _estimate(_improvement, _pair(x, y), **options)


def count_solved(rates: ArrayLike, threshold: float = 0.8) -> int:
    """How many tasks' mean over seeds is at least ``threshold``; rounding of the mean does not matter.

    Args:
        rates: (seeds, tasks), in [0, 1].
        threshold: in (0, 1].

    Raises:
        ValueError, TypeError: a wrong argument.

    Example:
        >>> count_solved([[0.8, 0.2, 1.0], [0.8, 0.9, 0.6]])
        2
    """
    if not 0 < threshold <= 1:
        raise ValueError(f"threshold must be in (0, 1], got {threshold!r}")
    return int((check_rates("rates", rates).mean(0) >= threshold - 1e-9).sum())


def _interquartile_mean(rates: Array) -> Array:
    flat = np.sort(rates.reshape(*rates.shape[:-2], -1), axis=-1)
    cut = flat.shape[-1] // 4
    return flat[..., cut : flat.shape[-1] - cut].mean(-1)


def _improvement(x: Array, y: Array) -> Array:
    wins = np.zeros(x.shape[:-2])
    for rates in np.moveaxis(x, -2, 0):  # a method's few seeds, not tasks or resamples
        beaten = rates[..., None, :]
        wins += ((beaten > y) + 0.5 * (beaten == y)).mean((-2, -1))
    return wins / x.shape[-2]


def _pair(x: ArrayLike, y: ArrayLike) -> list[Array]:
    pair = [check_rates("x", x), check_rates("y", y)]
    if pair[0].shape[1] != pair[1].shape[1]:
        raise ValueError(f"y must have x's tasks, {pair[0].shape[1]} columns, got {pair[1].shape[1]}")
    return pair


def _estimate(
    statistic: Callable[..., Array],
    methods: list[Array],
    *,
    resamples: int = 5000,
    seed: int = 0,
    confidence: float = 0.95,
    whole_seeds: bool = False,
    resample_tasks: bool = False,
) -> Estimate:
    """The statistic of the methods' rates, and its percentile interval over bootstrap resamples."""
    check_int("resamples", resamples, minimum=1)
    check_int("seed", seed, minimum=0)
    if not 0 < confidence < 1:
        raise ValueError(f"confidence must be in (0, 1), got {confidence!r}")
    value = float(statistic(*methods))
    if min(len(rates) for rates in methods) == 1:
        return Estimate(value)  # one seed says nothing of another: an interval would be a point
    drawn = _resampled(methods, resamples, seed, whole_seeds, resample_tasks)
    found = np.concatenate([statistic(*sample) for sample in drawn])
    low, high = np.quantile(found, [(1 - confidence) / 2, (1 + confidence) / 2])
    return Estimate(value, float(low), float(high))


def _resampled(
    methods: list[Array], resamples: int, seed: int, whole_seeds: bool, resample_tasks: bool
) -> Iterator[list[Array]]:
    """Resamples of each method's rates, (chunk, seeds, tasks), a chunk at a time."""
    rng = np.random.default_rng(seed)
    tasks = methods[0].shape[1]
    chunk = max(1, _CHUNK // max(rates.size for rates in methods))
    for start in range(0, resamples, chunk):
        count = min(chunk, resamples - start)
        columns = rng.integers(tasks, size=(count, 1, tasks)) if resample_tasks else np.arange(tasks)
        strata = 1 if whole_seeds else tasks
        yield [rates[rng.integers(len(rates), size=(count, len(rates), strata)), columns] for rates in methods]
