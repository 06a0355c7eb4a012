"""The files of a checkpoint: the trained policy, and the state that training resumes from."""

from __future__ import annotations

import signal
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from torch import Tensor, nn

from lw_torchrl._util.files import AnyPath, locked
from lw_torchrl._util.reproducibility import LIBRARIES, warn_of_other_versions
from lw_torchrl._util.tensor_files import pop_state
from lw_torchrl.training.checkpoint import (
    check_same_description,
    copy_tensors,
    read_file,
    short_message,
    text_vectors,
    training_file,
    write_file,
)


class Interrupt:
    """Records whether Ctrl-C was pressed once (``requested``) or twice (``insisted``)."""

    requested = insisted = False


@contextmanager
def interrupts_between_steps() -> Iterator[Interrupt]:
    """Record the first Ctrl-C, and raise :class:`KeyboardInterrupt` at the end of the block.

    A second Ctrl-C raises at once. Nothing changes outside the main thread, or where SIGINT is ignored.
    """
    interrupt = Interrupt()
    previous = signal.getsignal(signal.SIGINT) if threading.current_thread() is threading.main_thread() else None
    if not callable(previous):
        yield interrupt
        return

    def record(number: int, frame: FrameType | None) -> None:
        interrupt.insisted, interrupt.requested = interrupt.requested, True
        if interrupt.insisted:
            previous(number, frame)

    signal.signal(signal.SIGINT, record)
    try:
        yield interrupt
    except Exception as error:
        if interrupt.insisted:  # losses catch what tensordicts raise, and may turn it into another error
            raise KeyboardInterrupt from error
        raise
    finally:
        signal.signal(signal.SIGINT, previous)
    if interrupt.requested:
        raise KeyboardInterrupt


def contents_of(module: nn.Module) -> dict[str, Tensor]:
    """Return the tensors that a file holds of a module: weights by name, and the vectors of texts."""
    return {**module.state_dict(keep_vars=True), **text_vectors(module)}


class CheckpointFiles:
    """The file of a policy or evaluator, and the training state next to it, which one training at a time writes.

    Args:
        checkpoint: the file; None writes nothing.
        part: the kind of ``checkpoint``, "actor" or "evaluator"; None if it is the training state itself.
    """

    def __init__(self, checkpoint: AnyPath | None, part: str | None) -> None:
        self.checkpoint, self.part = None if checkpoint is None else Path(checkpoint), part
        self.state = training_file(self.checkpoint) if self.checkpoint and part else self.checkpoint
        self._known: tuple[int, ...] | None = None  # identifies the version of the state that was read or written last

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Lock these files against other trainings within the block."""
        if self.checkpoint is None:
            yield
            return
        with locked(self.checkpoint, "checkpoint", "training"):
            if self._version() not in (None, self._known):
                message = "was written by another training after this one began; start again to resume from it"
                raise ValueError(f"checkpoint: {str(self.checkpoint)!r} {message}, or choose another file")
            yield

    def _version(self) -> tuple[int, ...] | None:
        if self.state is None or not self.state.exists():
            return None
        status = self.state.stat()
        return status.st_ino, status.st_size, status.st_mtime_ns

    def write(
        self,
        description: Mapping[str, Any],
        device: torch.device,
        tensors: Mapping[str, Tensor],
        state: Any,
        part: nn.Module | None,
    ) -> None:
        """Write ``tensors`` and ``state``, then the policy or evaluator ``part``. Earlier files are replaced whole."""
        if self.checkpoint is None or self.state is None:
            return
        write_file(self.state, "training", {**description, "device": device.type}, tensors, state)
        self._known = self._version()
        if self.part is not None and part is not None:
            write_file(self.checkpoint, self.part, description, contents_of(part))

    def exist(self) -> bool:
        """Return whether there is a state; ValueError if there is only a policy, which would be overwritten."""
        if self.state is not None and self.state.exists():
            return True
        if self.checkpoint is not None and self.checkpoint.exists():
            message = f"{str(self.checkpoint)!r} exists, but not its training state {str(self.state)!r}"
            raise ValueError(f"checkpoint: {message}; choose another file, or delete it to start again")
        return False

    def restore(
        self,
        description: Mapping[str, Any],
        device: torch.device,
        tensors: Mapping[str, Tensor],
        load_state: Callable[[dict[str, Any]], None],
    ) -> None:
        """Copy the stored tensors into ``tensors`` and pass the stored state to ``load_state``."""
        assert self.checkpoint is not None
        assert self.state is not None
        begin, version = f"checkpoint: {str(self.state)!r}", self._version()
        stored_description, stored = read_file(self.state, "training")
        check_same_description(self.state, stored_description, description)
        if self.part is not None and self.checkpoint.exists():
            policy, _ = read_file(self.checkpoint, self.part)
            check_same_description(self.checkpoint, policy, {self.part: description[self.part]})
        if (before := stored_description["device"]) != device.type:
            warnings.warn(
                f"{begin} was trained on {before!r} and resumes on {device.type!r}: training continues with the "
                "same minibatches, but results will not be bit-identical to an uninterrupted run",
                stacklevel=4,
            )
        warn_of_other_versions(self.state, stored_description["versions"], LIBRARIES)
        try:
            state = pop_state(stored_description, stored)
            copy_tensors(stored, tensors)
            load_state(state)
        except (ValueError, KeyError, TypeError, RuntimeError) as error:
            message = f"{begin} does not fit, it is damaged or of another architecture"
            raise ValueError(f"{message} ({short_message(error)})") from error
        self._known = version
