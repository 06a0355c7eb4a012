"""Check that the time per environment, and per row of a dataset, does not grow with the number of them."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any

import torch
from tensordict import TensorDict

import lw_torchrl as lw
from benchmarks.report import Row, Settings, times_as_long, under

STEPS = 500
PARTS = {"environments": ("construction", "reset", "first step", "later step"), "rows": ("construction", "first batch")}
LATER = 5  # the number of steps after the first
GROWTH = 8  # the ratio of the large number to the small one
MOST = 1.3  # the maximum ratio of the times per environment or row


def write_dataset(root: Path, rows: int) -> None:
    """Write a dataset of random rows, in 500-step episodes of all 50 tasks."""
    from lw_torchrl.data import dataset
    from lw_torchrl.language.tasks import task_id

    each = rows // STEPS // len(lw.MT50)
    config = dataset.CollectConfig(tuple(lw.MT50), each, seed=0)
    keys = {key: torch.rand(STEPS, *shape).to(dtype) for key, (shape, dtype) in dataset.COLUMNS.items()}

    def episode(task: str, number: int) -> TensorDict:
        steps = TensorDict(keys, [STEPS])
        for key, value in ((("task_id",), task_id(task)), (("next", "task_id"), task_id(task)), ("episode", number)):
            steps[key] = torch.full((STEPS,), value)
        return steps

    episodes = ((task, number, episode(task, number)) for task in lw.MT50 for number in range(each))
    infos = dataset.write_rows(root / dataset.DATA, episodes, config.layout)
    ids, attempts = {task: task_id(task) for task in lw.MT50}, dict.fromkeys(lw.MT50, each)
    dataset.write_metadata(dataset.Demonstrations(root, config, {}, ids, infos, attempts))


def peak() -> float:
    """Return the peak memory of this process in GB, without that of the process which started it."""
    return int(re.findall(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text("ascii"))[0]) / 1e6


def measure(kind: str, number: int, root: str) -> dict[str, float]:
    """Return the CPU seconds for each part on one thread, and the memory in GB without the imports."""
    times, before = [process_time()], peak()
    if kind == "environments":
        env = lw.LanguageWorldEnv("MT50", num_envs=number, num_threads=1)
        times.append(process_time())
        state = env.reset()
        times.append(process_time())
        state = env.step(env.rand_action(state))["next"]
        times.append(process_time())
        for _ in range(LATER):
            state = env.step(env.rand_action(state))["next"]
        times.append(times[-1] + (process_time() - times[-1]) / LATER)
    else:
        transform = lw.QAFTransform(lw.load_plans("MT50"))
        replay = lw.LanguageWorldExperienceReplay(
            root, sampler=lw.TaskBalancedSampler(), transform=transform, batch_size=500
        )
        times.append(process_time())
        replay.sample()
        times.append(process_time())
    seconds = (end - start for start, end in pairwise(times))
    return dict(zip(PARTS[kind], seconds, strict=True)) | {"memory": peak() - before}


def large(settings: Settings) -> list[Row]:
    """Compare 4,096 environments, and a dataset of 1,000,000 rows, with an eighth of each, all in new processes."""
    lines: list[Row] = []
    for kind, full, quick in (("environments", 4096, 400), ("rows", 1_000_000, 200_000)):
        number, found = settings.pick(full, quick), []
        for size in (number, number // GROWTH):
            with TemporaryDirectory() as folder:
                if kind == "rows":
                    write_dataset(Path(folder), size)
                command = [sys.executable, "-W", "ignore", "-m", "benchmarks.large", kind, str(size), folder]
                done = subprocess.run(command, capture_output=True, text=True, check=True)
                found.append(json.loads(done.stdout.splitlines()[-1]))
        for part in PARTS[kind]:
            ours, theirs = ([each[part] / size] for each, size in zip(found, (number, number // GROWTH), strict=True))
            name = f"{number:,} {kind}: {part}, of each"
            lines.append(times_as_long(name, ours, f"{number // GROWTH:,}", theirs, unit="µs", scale=1e6, at_most=MOST))
        lines.append(under(f"{number:,} {kind}: memory", found[0]["memory"], "GB", 8))
    return lines


if __name__ == "__main__":
    result: Any = measure(sys.argv[1], int(sys.argv[2]), sys.argv[3])
    print(json.dumps(result))
