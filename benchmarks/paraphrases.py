"""python -m benchmarks.paraphrases: paraphrase the skills of the shipped plans with a language model on a server."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

import lw_torchrl as lw
from lw_torchrl._util.files import read_json, write_json
from lw_torchrl._util.progress import Progress

ASKED = "Say the command to a robot in other words. Keep what it means. Answer with one short command and nothing else."
SHOWN = (
    ("open the window", "Slide the window open."),
    ("put the bread on the plate", "Place the bread onto the plate."),
    ("shut the cupboard", "Close the door of the cupboard."),
)


@dataclass(frozen=True)
class Arguments:
    """Request paraphrases of each skill from a model. The stored ones are by SmolLM2 with 135 million parameters."""

    base_url: str = "http://127.0.0.1:8000/v1"
    """Address of a server with an OpenAI-compatible API."""
    model: str = "smollm2-135m"
    """Name of the model on the server."""
    number: int = 10
    """Number of paraphrases per skill."""
    temperature: float = 0.8
    """Maximum number of answers per skill, with seeds from 0."""
    out: Path = Path(__file__).parent / "data" / "paraphrases.json"
    """File of paraphrases by skill; existing ones are kept."""


def main(arguments: Arguments) -> None:
    from openai import OpenAI

    client = OpenAI(base_url=arguments.base_url, api_key="none")
    found: dict[str, list[str]] = read_json(arguments.out, "out") if arguments.out.is_file() else {}
    skills = [skill for skill in lw.load_plans("MT50").skills if len(found.get(skill, ())) < arguments.number]
    with Progress("paraphrasing", len(skills), "skill") as progress:
        for skill in skills:
            found[skill] = [paraphrase(client, arguments, skill, seed) for seed in range(arguments.number)]
            write_json(arguments.out, found)
            progress.update()


def paraphrase(client: Any, arguments: Arguments, skill: str, seed: int) -> str:
    """Return the first line of the model's answer unchecked, because wrong paraphrases are part of the experiment."""
    messages: list[dict[str, str]] = [{"role": "system", "content": ASKED}]
    for said, other in (*SHOWN, (skill, "")):
        messages += [{"role": "user", "content": said}, {"role": "assistant", "content": other}]
    reply = client.chat.completions.create(
        model=arguments.model, messages=messages[:-1], temperature=arguments.temperature, seed=seed, max_tokens=30
    )
    lines = (reply.choices[0].message.content or "").strip().splitlines()
    return lines[0].strip(" \"'.").lower() if lines else skill


if __name__ == "__main__":
    main(tyro.cli(Arguments))
