"""Compiled MuJoCo models, shared: one for each XML file, lent to one engine at a time."""

from __future__ import annotations

import copy
import importlib.metadata
import threading
from collections.abc import Iterable
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

SUPPORTED_VERSIONS = {"metaworld": "3.1.1", "mujoco": "3.3.0"}


def check_versions() -> None:
    """Refuse a Meta-World or MuJoCo whose numbers have not been compared with this engine's.

    Raises:
        ImportError: names the installed and the supported version.
    """
    for package, supported in SUPPORTED_VERSIONS.items():
        try:
            installed = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            installed = "none"
        if installed != supported:
            raise ImportError(
                f"the vectorized engine reproduces {package} {supported}, but the installed version is "
                f"{installed}. Install {package}=={supported}, or choose engine='metaworld', which runs "
                "whatever is installed."
            )


class SharedModel:
    """A compiled model that many rows use in turn.

    A reset of a Meta-World task moves bodies and sites of the model itself, so each row keeps its own
    ``body_pos`` and ``site_pos`` and :meth:`load`\\ s them before its physics. The rows of one shared model
    must therefore never run at the same time.

    Attributes:
        holder: whose bodies and sites are in the model now; a row that finds itself here need not load.
    """

    def __init__(self, path: str, model: Any) -> None:
        self.path = path
        self.model = model
        self.body_pos: NDArray[np.float64] = model.body_pos
        self.site_pos: NDArray[np.float64] = model.site_pos
        self.compiled_body_pos = self.body_pos.copy()
        self.compiled_site_pos = self.site_pos.copy()
        self.holder: object = None

    def load(self, holder: object, body_pos: NDArray[np.float64], site_pos: NDArray[np.float64]) -> None:
        """Put the holder's bodies and sites into the model."""
        self.holder = holder
        self.body_pos[...] = body_pos
        self.site_pos[...] = site_pos

    def restore(self) -> None:
        """Put the bodies and sites back where the XML file has them."""
        self.load(None, self.compiled_body_pos, self.compiled_site_pos)

    def duplicate(self) -> SharedModel:
        """A second model, for rows that are to run beside this one's; copied, not compiled."""
        twin = SharedModel(self.path, copy.copy(self.model))
        # Somebody may be using this model just now: take what never changes from it, not its present state.
        twin.compiled_body_pos = self.compiled_body_pos
        twin.compiled_site_pos = self.compiled_site_pos
        twin.restore()
        return twin


# An engine that is forgotten gives its models back whenever Python collects it, be it inside borrow_model.
_lock = threading.RLock()
_compiled: dict[str, SharedModel] = {}
_idle: dict[str, SharedModel] = {}


def borrow_model(path: str) -> SharedModel:
    """A model of the XML file that nobody else uses, compiled only if this process never did so before."""
    with _lock:
        if (idle := _idle.pop(path, None)) is not None:
            return idle
        if path in _compiled:
            return _compiled[path].duplicate()
        _compiled[path] = SharedModel(path, mujoco.MjModel.from_xml_path(path))
        return _compiled[path]


def return_models(models: Iterable[SharedModel]) -> None:
    """Give borrowed models back. One of each XML file is kept for the next borrower."""
    with _lock:
        for model in models:
            model.restore()
            _compiled[model.path] = _idle.setdefault(model.path, model)
