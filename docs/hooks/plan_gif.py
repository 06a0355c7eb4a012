"""Draw the README's moving picture: the shipped policy, next to its plan with the active step lit.

    python docs/hooks/plan_gif.py --out docs/plan.gif

The frames come from the simulator, and a step is lit by the policy's attention weight. Rendering needs OpenGL.
"""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from matplotlib import font_manager
from PIL import Image, ImageDraw, ImageFont
from torchrl.envs import TransformedEnv

import lw_torchrl as lw
from lw_torchrl.record.recorded_episode import short_condition

SIZE = (820, 450)  # legible at half size, on a telephone
SCENE_WIDTH = 310
MARGIN = 16
PANEL, LIT, DIM, TEXT, SUCCESS = (30, 36, 46), (0, 105, 100), (150, 160, 172), (240, 244, 248), (255, 202, 88)
CONDITION_LETTERS, SKILL_LETTERS = 46, 36  # letters that fit into one line


@dataclass(frozen=True)
class Arguments:
    """Write a GIF of episodes of one policy, one task after the other."""

    tasks: tuple[str, ...] = ("drawer-open", "pick-place")
    policy: str = "few-shot-mt50"
    seed: int = 1_000
    camera: str = "corner4"
    every: int = 2
    """Draw every N-th time step."""
    milliseconds: int = 90
    """Time for which a frame is shown; the last frame of a task is shown for two seconds."""
    hold: int = 12
    """Time steps to record after success."""
    out: Path = Path("docs/plan.gif")


def record(task: str, args: Arguments) -> tuple[list[Any], list[Any], list[bool]]:
    """Run one episode until shortly after success; return its images, attention weights and success flags."""
    plans = lw.load_plans("MT50")
    actor = lw.load_actor(args.policy).eval()
    base = lw.LanguageWorldEnv(task, seed=args.seed, num_threads=1)
    env = TransformedEnv(base, lw.QAFTransform(plans))
    images, weights, successes = [], [], []
    with torch.no_grad():
        step = env.reset()
        while len(successes) < 400 and sum(successes) < args.hold:
            acted = env.step(actor(step))
            if len(weights) % args.every == 0:
                image = base.render(camera=args.camera, height=2 * SIZE[1], width=2 * SIZE[1])
                images.append(image[0].numpy())
            weights.append(acted["skill_weights"][0].numpy())
            successes.append(bool(acted["next", "success"].any()))
            step = acted["next"]
    env.close()
    if not successes[-1]:
        raise RuntimeError(f"{task} failed with seed {args.seed}; choose another --seed")
    return images, weights[:: args.every], successes[:: args.every]


def font(size: int, *, bold: bool = False) -> ImageFont.FreeTypeFont:
    """Return matplotlib's own sans-serif font, which is the same on every machine."""
    weight = "bold" if bold else "normal"
    return ImageFont.truetype(font_manager.findfont(f"DejaVu Sans:weight={weight}"), size)


def draw(task: str, plan: lw.ConditionalPlan, image: Any, weights: Any, succeeded: bool) -> Image.Image:
    """Draw one frame: the scene on the left, the plan on the right."""
    frame = Image.new("RGB", SIZE, PANEL)
    scene = Image.fromarray(image).resize((SIZE[1], SIZE[1]), Image.Resampling.LANCZOS)
    left = (SIZE[1] - SCENE_WIDTH) // 2
    frame.paste(scene.crop((left, 0, left + SCENE_WIDTH, SIZE[1])), (0, 0))
    pen = ImageDraw.Draw(frame)
    x, y = SCENE_WIDTH + MARGIN, MARGIN
    pen.text((x, y), task, font=font(24, bold=True), fill=TEXT)
    if succeeded:
        pen.text((SIZE[0] - MARGIN, y), "success", font=font(24, bold=True), fill=SUCCESS, anchor="ra")
    y += 42
    for step, weight in zip(plan.steps, weights, strict=False):
        conditions = textwrap.wrap(f"if {short_condition(step.condition)}:", CONDITION_LETTERS)
        skills = textwrap.wrap(step.skill, SKILL_LETTERS)
        height = 23 * len(conditions) + 27 * len(skills) + 16
        color = tuple(round(a + (b - a) * float(weight)) for a, b in zip(PANEL, LIT, strict=True))
        pen.rounded_rectangle((x - 8, y, SIZE[0] - 8, y + height), 8, fill=color)
        fill = TEXT if weight > 0.5 else DIM
        for number, line in enumerate(conditions):
            pen.text((x, y + 6 + 23 * number), line, font=font(18), fill=fill)
        for number, line in enumerate(skills):
            pen.text((x, y + 8 + 23 * len(conditions) + 27 * number), line, font=font(22, bold=True), fill=fill)
        y += height + 6
    return frame


def main(args: Arguments) -> None:
    frames: list[Image.Image] = []
    durations: list[int] = []
    for task in args.tasks:
        plan = lw.load_plans("MT50")[task]
        drawn = [draw(task, plan, *parts) for parts in zip(*record(task, args), strict=True)]
        frames += drawn
        durations += [args.milliseconds] * (len(drawn) - 1) + [2_000]
    # One palette for all frames, so that pixels that do not change are stored once.
    stripe = np.full((40, SIZE[0], 3), SUCCESS, np.uint8)  # else so rare a colour gets no entry
    sample = Image.fromarray(np.concatenate([stripe, *map(np.asarray, frames[:: len(frames) // 8])]))
    palette = sample.quantize(128, method=Image.Quantize.MEDIANCUT)
    small = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    args.out.parent.mkdir(parents=True, exist_ok=True)
    small[0].save(args.out, save_all=True, append_images=small[1:], duration=durations, loop=0)
    print(f"{args.out}: {len(frames)} frames, {args.out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(tyro.cli(Arguments))
