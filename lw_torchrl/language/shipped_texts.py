"""The texts whose vectors the package carries: ``python -m lw_torchrl.language.shipped_texts`` encodes them anew."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from lw_torchrl._files import replacing
from lw_torchrl.language.plan_files import load_plans
from lw_torchrl.language.tasks import TASKS
from lw_torchrl.language.text import TABLE, sentence_encoder


def shipped_texts() -> list[str]:
    """The task descriptions and the skills of the shipped plans, sorted."""
    skills = {*load_plans("MT50").skills, *load_plans("MT50", skills="MT10").skills}
    return sorted({task.description for task in TASKS.values()} | skills)


def write_table(path: Path, texts: Iterable[str]) -> None:
    """Encode ``texts`` and write them with their vectors, half precision, as an .npz without pickles."""
    listed = list(texts)
    with replacing(path) as temporary:
        np.savez_compressed(
            temporary, texts=np.array(listed), vectors=sentence_encoder(listed).numpy().astype(np.float16)
        )


if __name__ == "__main__":
    target = Path(__file__).parent / "data" / TABLE
    write_table(target, shipped_texts())
    print(f"{len(shipped_texts())} texts written to {target.name}")
