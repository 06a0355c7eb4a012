"""WORDS: the tables of data/words.toml."""

from collections.abc import Mapping
from importlib.resources import files
from typing import Any

from lw_torchrl._files import read_toml

WORDS: Mapping[str, Any] = read_toml(files("lw_torchrl.language") / "data" / "words.toml", ValueError)
