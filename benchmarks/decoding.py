"""python -m benchmarks.decoding FILE [--count 100000]: test decode_plan on recorded answers and on mutations of them.

Each line of FILE is an answer: JSON with "completion", "task" and "format". The command prints how many answers give a
plan, and the CPU time of a call in this thread, which does not depend on other processes. It fails if a text raises an
error, or if a mutation takes longer than --most.
"""

from __future__ import annotations

import json
import random
import sys
from pathlib import Path
from time import thread_time

import tyro

import lw_torchrl as lw

_ODD = "\"'\\`#-:()[]{}<>*.,=\n\t\r\x00\x0b\x85\u2028\ufeff\ud800é手🤖 0"
_WORDS = (
    'if check("', '"):', "robot.", "move_gripper(", "def ", "else:", "elif ", "print(", "```", "[eod]", "# Steps:",
    "Steps:  1. ", "- When ", ", the robot should ", "move the robot's gripper until ", " and ", " not ", "The task `",
    "\n    ", '\\"',
)  # fmt: skip


def mutated(draw: random.Random, text: str, texts: list[str]) -> str:
    """Return a text with up to eight random changes of characters, spans or lines, also with parts of other texts."""
    for _ in range(draw.randint(1, 8)):
        start = draw.randint(0, len(text))
        end = min(len(text), start + int(draw.expovariate(1 / 40)))
        span = text[start:end]
        kind = draw.randrange(9)
        if kind == 0:
            text = text[:start] + text[end:]
        elif kind == 1:
            text = text[:end] + span + text[end:]
        elif kind == 2:
            text = text[:start] + "".join(draw.choices(_ODD, k=draw.randint(1, 8))) + text[end:]
        elif kind == 3:
            text = text[:start] + draw.choice(_WORDS) + text[start:]
        elif kind == 4:
            text = text[:start]
        elif kind == 5:
            other = draw.choice(texts)
            text = text[:start] + other[draw.randint(0, len(other)) :]
        elif kind == 6:
            lines = text.split("\n")
            draw.shuffle(lines)
            text = "\n".join(lines)
        elif kind == 7:
            text = text[:start] + draw.choice([*_WORDS, *_ODD]) * draw.randint(2, 300) + text[start:]
        else:
            text = text.replace(draw.choice(_ODD), draw.choice(_ODD))
    return text[:8000]


def main(file: tyro.conf.Positional[Path], count: int = 100_000, seed: int = 0, most: float = 0.05) -> None:
    rows = [json.loads(line) for line in file.read_text("utf-8").splitlines()]
    for name in lw.TASKS:  # build the cached tables before timing
        lw.decode_plan('if check("the gripper is holding it"):\n    robot.grab("it")', name, "basic_py")
    found = [_timed(row["completion"], row["task"], row["format"]) for row in rows]
    print(f"{len(rows)} answers: {sum(plan for plan, _ in found)} give a plan" + _costs([cost for _, cost in found]))
    draw, texts = random.Random(seed), [row["completion"] for row in rows]
    costs: list[float] = []
    for number in range(count):
        row = draw.choice(rows)
        text, task, format = mutated(draw, row["completion"], texts), row["task"], row["format"]
        if draw.random() < 0.3:
            task, format = draw.choice(list(lw.TASKS)), draw.choice(list(lw.PLAN_FORMATS))
        try:
            cost = _timed(text, task, format)[1]
        except Exception:
            print(f"mutation {number} of seed {seed}, {task}, {format}: {text!r}", file=sys.stderr)
            raise
        if cost > most:
            print(f"mutation {number}, {task}, {format}: {cost * 1e3:.0f} ms", file=sys.stderr)
        costs.append(cost)
    print(f"{count} mutations: none raises" + _costs(costs))
    if max(costs) > most:
        sys.exit(f"{sum(cost > most for cost in costs)} of them took more than {most * 1e3:.0f} ms")


def _timed(text: str, task: str, format: str) -> tuple[bool, float]:
    start = thread_time()
    decoded = lw.decode_plan(text, task, format)
    cost = thread_time() - start
    assert (decoded.plan is None) == bool(decoded.reason)
    return decoded.plan is not None, cost


def _costs(costs: list[float]) -> str:
    ordered = sorted(costs)
    at = {
        name: ordered[int(share * (len(ordered) - 1))] * 1e3
        for name, share in (("median", 0.5), ("99.9 %", 0.999), ("most", 1))
    }
    return "; " + ", ".join(f"{name} {value:.1f} ms" for name, value in at.items())


if __name__ == "__main__":
    tyro.cli(main)
