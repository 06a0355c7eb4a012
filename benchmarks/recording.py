"""Benchmarks of the time and size of recordings: the page of an episode, and one of 50 rows recorded live."""

from __future__ import annotations

import os
from statistics import median
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

import torch
from torchrl.envs import Compose, TransformedEnv

import lw_torchrl as lw
from benchmarks.report import Row, Settings, timed, under
from lw_torchrl.record.meshes import Motion
from lw_torchrl.record.rollouts import read_rollout, run_recorded, simulate_again

TASK, SEED = "pick-place", 0
EPISODES = 10


def recording(settings: Settings) -> list[Row]:
    """Record one and ten episodes of scripted skills with the robot's motion, and one of 50 rows during a rollout."""
    steps = settings.pick(500, 20)
    plans = lw.load_plans("MT50")
    rollout = _rollout(plans, steps)
    heading, episode = read_rollout(rollout, plans, seed=SEED, policy="scripted")
    motion: Any = None

    def simulate() -> None:
        nonlocal motion
        motion = simulate_again(TASK, SEED, 0, episode.action, episode.observation)

    simulate()  # compiles the model
    simulating = timed(simulate)
    assert isinstance(motion, Motion)
    with TemporaryDirectory() as folder:
        one, ten = f"{folder}/one.rrd", f"{folder}/ten.rrd"
        with lw.RerunLogger(one) as logger:
            first = timed(lambda: logger.add_page(heading, episode, motion=motion))
        with lw.RerunLogger(ten) as logger:
            pages = [timed(lambda: logger.add_page(heading, episode, motion=motion)) for _ in range(EPISODES)]
        sizes = [os.path.getsize(path) / 1e6 for path in (one, ten)]
        live = _live(settings, plans, folder)
        many = _many(settings, plans, folder)
    name = f"recorded episode of {steps} steps:"
    return [
        under(
            f"{name} page, after the first of its model", median(pages) * 1e3, "ms", 40, f"first {first * 1e3:.0f} ms"
        ),
        Row(f"{name} simulating it again", simulating * 1e3, "ms"),
        under(f"{name} file", sizes[0], "MB", 2, "with meshes"),
        under(f"{EPISODES} recorded episodes of {steps} steps: file", sizes[1], "MB", 8, "with meshes"),
        *many,
        live,
    ]


def _many(settings: Settings, plans: lw.Plans, folder: str) -> list[Row]:
    """Return the size of a recording of three episodes of each of eight tasks."""
    tasks, length = lw.MT10[: settings.pick(8, 2)], settings.pick(150, 20)
    actor = lw.ScriptedSkillActor(plans)
    episodes = run_recorded(actor, tasks, plans=plans, seed=1_000, episodes=range(3), max_steps=length)
    with lw.RerunLogger(f"{folder}/many.rrd") as logger:
        for episode in episodes:
            lw.log_rollout(logger, episode.steps, plans, seed=1_000, policy="scripted")
    size = os.path.getsize(f"{folder}/many.rrd") / 1e6
    return [under(f"{len(episodes)} recorded episodes of {length} steps, {len(tasks)} tasks: file", size, "MB", 6)]


def _rollout(plans: lw.Plans, steps: int) -> Any:
    base = lw.LanguageWorldEnv(TASK, seed=SEED, num_threads=1, max_steps=steps)
    env = TransformedEnv(base, lw.QAFTransform(plans))
    with torch.no_grad():
        rollout = env.rollout(steps, lw.ScriptedSkillActor(plans))[0]
    env.close()
    return rollout


def _live(settings: Settings, plans: lw.Plans, folder: str) -> Row:
    """Measure the recorder's share of the time of rollouts with 50 rows, including the page."""
    steps = settings.pick(500, 20)
    actor = lw.ScriptedSkillActor(plans)
    totals, own = [], []
    for number in range(settings.pick(5, 1)):
        logger = lw.RerunLogger(f"{folder}/live-{number}.rrd")
        recorder = _Timed(logger, plans=plans)
        base = lw.LanguageWorldEnv("MT50", seed=SEED, max_steps=steps)
        env = TransformedEnv(base, Compose(lw.QAFTransform(plans), recorder))
        recorder.seconds = 0.0
        with torch.no_grad():
            totals.append(timed(lambda env=env: env.rollout(steps, actor)))
        own.append(recorder.seconds)
        env.close()
        logger.shutdown()
    ratios = [total / (total - seconds) for total, seconds in zip(totals, own, strict=True)]
    ratio = median(ratios)
    return Row(
        f"rollout of 50 rows × {steps} steps, one recorded live",
        median(totals),
        "s",
        "without the recorder's share",
        median(totals) / ratio,
        ratio,
        (min(ratios), max(ratios)),
        "≤ 1.01",
        ratio <= 1.01,
        f"{median(own) / steps * 1e6:.0f} µs a step",
    )


class _Timed(lw.record.RolloutRecorder):
    """A recorder that measures the seconds spent in its own methods."""

    seconds = 0.0

    def _step(self, *arguments: Any) -> Any:
        start = perf_counter()
        found = super()._step(*arguments)
        self.seconds += perf_counter() - start
        return found

    def _reset(self, *arguments: Any) -> Any:
        start = perf_counter()
        found = super()._reset(*arguments)
        self.seconds += perf_counter() - start
        return found
