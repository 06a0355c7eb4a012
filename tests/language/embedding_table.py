"""Write the shipped text vectors again after a shipped text changed: ``python tests/language/embedding_table.py``."""

from pathlib import Path

import numpy as np

import lw_torchrl as lw
from lw_torchrl._util.files import replacing
from lw_torchrl.language import text


def shipped_texts():
    """The task descriptions and the skills of the shipped plans, sorted."""
    skills = {*lw.load_plans("MT50").skills, *lw.load_plans("MT50", skills="MT10").skills}
    return sorted({task.description for task in lw.TASKS.values()} | skills)


def write_table(path, texts):
    """Encode texts and write them with their vectors, half precision, as an .npz without pickles."""
    vectors = text.sentence_encoder(texts).numpy().astype(np.float16)
    with replacing(path) as temporary:
        np.savez_compressed(temporary, texts=np.array(texts), vectors=vectors)


if __name__ == "__main__":
    write_table(Path(text.__file__).parent / "data" / text.TABLE, shipped_texts())
