"""The training loop of all trainers: progress, logs, Ctrl-C, and checkpoints that training resumes from."""

from __future__ import annotations

import signal
import threading
import warnings
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import FrameType
from typing import Any, ClassVar, TypedDict

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import TensorDictReplayBuffer
from torchrl.record.loggers import Logger

from lw_torchrl._checks import check_int, checked
from lw_torchrl._devices import CPU, drawn_on
from lw_torchrl._files import AnyPath, locked
from lw_torchrl._progress import Progress
from lw_torchrl._tensor_files import pop_state
from lw_torchrl._versions import LIBRARIES, warn_of_other_versions
from lw_torchrl.data.replay import LanguageWorldExperienceReplay
from lw_torchrl.training.checkpoint import (
    check_finite,
    check_same_description,
    copy_tensors,
    read_file,
    short_message,
    text_vectors,
    training_file,
    write_file,
)

READ_EVERY = 100
"""Steps between readings of the losses, which wait for the device."""

Schedule = torch.optim.lr_scheduler.LRScheduler


class ReplayState:
    """A replay buffer, and the generators that it, its transforms and the networks draw from, all from one seed."""

    def __init__(self, replay: TensorDictReplayBuffer, seed: int) -> None:
        self.replay, self.generator = replay, torch.Generator().manual_seed(seed)
        replay.set_rng(self.generator)
        self.torch_generator = self.generator.get_state()

    @contextmanager
    def drawing(self, device: torch.device) -> Iterator[None]:
        """Use this training's generators as the global ones within the block."""
        with drawn_on(device, self.torch_generator):
            yield
            self.torch_generator = torch.get_rng_state()

    def minibatch(self, size: int, device: torch.device) -> TensorDictBase:
        """Return a minibatch on the device, copied if the buffer's rows are elsewhere."""
        batch = self.replay.sample(size)
        return batch if device == CPU else batch.to(device, non_blocking=True)

    def state_dict(self, step: int) -> dict[str, Any]:
        return {
            "step": step,
            "generator": self.generator.get_state(),
            "torch_generator": self.torch_generator.clone(),
            "sampler": dict(self.replay.sampler.state_dict()),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.generator.set_state(state["generator"])
        self.torch_generator = state["torch_generator"].clone()
        if state["sampler"]:
            self.replay.sampler.load_state_dict(state["sampler"])


class TrainingOptions(TypedDict, total=False):
    """Options of :class:`Training` that every trainer accepts."""

    checkpoint: AnyPath | None
    logger: Logger | None
    progress: bool
    title: str


class Training:
    """Base class of the trainers. A subclass creates ``optimizer`` and ``module`` and implements :meth:`step`.

    Args:
        config: how to train, with ``steps``, ``checkpoint_every`` and ``learning_rate``; None for the defaults.
        replays: the buffers. Their generators are set to the configuration's seed.
        checkpoint: the file to write the trained policy to, "mt10.safetensors". The training state is written next to
            it, "mt10.training.safetensors"; if it is there already, training resumes from it.
        logger: a TorchRL logger for what :meth:`means` gives, every 100 steps.
        progress, title: show a progress bar, and its title.

    Attributes:
        module: holds everything that is trained.
        steps: minibatches so far.
        states: one for each buffer.
        networks, device: the networks, in train mode during :meth:`run`, and their device.
        described: the description of the training, as JSON: it resumes only from a state of the same description.
        part: the kind of file that is written besides the training state, "actor" or "evaluator"; None for only the
            training state, which then has the name ``checkpoint``.

    Warns:
        UserWarning: the checkpoint was written on another kind of device, or under other versions of torch, say:
            training resumes with the same minibatches, but not bit for bit.

    Raises:
        ValueError: the checkpoint is damaged, or of other architecture, configuration or data; a loss or weight is NaN.
        OSError: the checkpoint cannot be written; the earlier one stays.
    """

    part: ClassVar[str | None] = None
    module: nn.Module
    optimizer: torch.optim.Optimizer
    schedule: Schedule | None = None
    device = CPU
    _last_stamp: tuple[int, ...] | None = None  # of the training state's file that was read or written last

    @checked
    def __init__(
        self,
        config: Any,
        replays: Sequence[TensorDictReplayBuffer],
        *,
        checkpoint: AnyPath | None = None,
        logger: Logger | None = None,
        progress: bool = True,
        title: str = "training",
    ) -> None:
        self.config, self.logger, self.progress, self.title = config, logger, progress, title
        self.replays = list(replays)
        self.checkpoint = None if checkpoint is None else Path(checkpoint)
        self.steps = 0
        self.states: list[ReplayState] = []
        self.networks: list[nn.Module] = []
        self.described: dict[str, Any] = {}
        self._losses: deque[Tensor] = deque(maxlen=READ_EVERY)

    def step(self) -> Any:
        """Compute a minibatch's loss and pass it to :meth:`descend`."""
        raise NotImplementedError

    def parameters(self) -> dict[str, Tensor]:
        """Return the trained parameters by name."""
        return dict(self.module.named_parameters())

    def contents(self) -> dict[str, Tensor]:
        """Return the tensors that a checkpoint holds: weights by name, and the vectors of texts."""
        return {**self.module.state_dict(keep_vars=True), **text_vectors(self.module)}

    def clip_gradients(self) -> None:
        """Clip the gradients before the optimizer's step."""

    def means(self, losses: Tensor) -> dict[str, float]:
        """Return the values to log for the last losses, (n,) or (n, M) float32 on the CPU; the progress bar shows those
        with "loss" in their name."""
        return {"loss": losses.mean().item()}

    def descend(self, losses: Tensor) -> Tensor:
        """Take an optimizer step on the loss, () float32, or those of M models, (M,) float32, and return it detached.

        On a GPU this does not wait for the device: :meth:`run` reports later that a loss is not finite.
        """
        if self.device == CPU:
            self._check_loss(losses, self.steps)
        self.optimizer.zero_grad()
        losses.sum().backward()
        self.clip_gradients()
        self.optimizer.step()
        if self.schedule is not None:
            self.schedule.step()
        self.steps += 1
        self._losses.append(losses.detach())
        return losses.detach()

    def run(self, until: int | None = None) -> Tensor:
        """Train to the last step, or to step ``until``; Ctrl-C ends training between two steps, with a checkpoint.

        Returns:
            The losses of the last 100 steps, (n,) or (n, M) float32 on the CPU.
        """
        total = self.config.steps
        if until is not None and check_int("until", until, minimum=1) > total:
            raise ValueError(f"until must be at most the configuration's steps, {total}, got {until}")
        self._losses.clear()
        for network in self.networks:
            network.train()
        last = total if until is None else until
        with self.at_work(total, self.steps) as (bar, interrupt):
            if self.steps >= last:
                self.save()  # the process may have been killed after it wrote the training state, before the policy
            while self.steps < last and not interrupt.asked:
                self.step()
                bar.update()
                saves = self.steps % self.config.checkpoint_every == 0 or self.steps == last
                tells = self.steps % READ_EVERY == 0 or self.steps == last
                losses = self._read_losses() if saves or tells else None
                if tells and losses is not None:
                    self.log(found := self.means(losses), self.steps)
                    bar.note(**{name: f"{value:.4f}" for name, value in found.items() if "loss" in name})
                if saves:
                    self.save()
            if interrupt.asked:
                self._read_losses()
                self.save()
        for network in self.networks:
            network.eval()
        return self._read_losses()

    def log(self, found: Mapping[str, float], step: int) -> None:
        if self.logger is not None:
            for name, value in found.items():
                self.logger.log_scalar(f"train/{name}", value, step=step)

    def _read_losses(self) -> Tensor:
        """Return the latest losses; raise :class:`ValueError` if one is not finite."""
        if not self._losses:
            return torch.empty(0)
        found = torch.stack(tuple(self._losses)).cpu()
        if not found.isfinite().all():
            for number, loss in enumerate(found, self.steps - len(found)):
                self._check_loss(loss, number)
        return found

    def _check_loss(self, losses: Tensor, step: int) -> None:
        if losses.isfinite().all():
            return
        which = int((~losses.reshape(-1).isfinite()).nonzero()[0])
        of = f" of actor {which}" if losses.ndim else ""
        raise ValueError(
            f"the loss{of} is {losses.reshape(-1)[which].item()} at step {step}: the demonstrations hold NaN, or the "
            f"learning rate {self.config.learning_rate} is too high"
        )

    @contextmanager
    def at_work(self, total: int, done: int) -> Iterator[tuple[Progress, Interrupt]]:
        """Lock the checkpoint against other trainings, show progress and take Ctrl-C between steps."""
        bar = Progress(self.title, total, "step", initial=done, show=self.progress)
        lock = nullcontext() if self.checkpoint is None else locked(self.checkpoint, "checkpoint", "training")
        with lock, bar, interrupts_between_steps() as interrupt:
            if self._stamp() not in (None, self._last_stamp):
                message = "was written by another training after this one began; start again to resume from it"
                raise ValueError(f"checkpoint: {str(self.checkpoint)!r} {message}, or choose another file")
            yield bar, interrupt

    def _stamp(self) -> tuple[int, ...] | None:
        """Return what tells one version of the training state's file from another; None without a file."""
        if self.state_file is None or not self.state_file.exists():
            return None
        status = self.state_file.stat()
        return status.st_ino, status.st_size, status.st_mtime_ns

    @property
    def state_file(self) -> Path | None:
        """The file of the training state."""
        return training_file(self.checkpoint) if self.checkpoint is not None and self.part else self.checkpoint

    def save(self) -> None:
        """Write the checkpoint, if there is one to write; earlier files are replaced whole."""
        try:
            check_finite(self.parameters())
        except ValueError as error:
            raise ValueError(f"{error} after step {self.steps}: the learning rate is too high") from error
        if self.checkpoint is not None and self.state_file is not None:
            described, tensors = {**self.described, "device": self.device.type}, self.contents()
            write_file(self.state_file, "training", described, tensors, self.state_dict())
            self._last_stamp = self._stamp()
            if self.part is not None:
                write_file(self.checkpoint, self.part, self.described, tensors)

    def resume(self) -> bool:
        """Resume from the checkpoint and return True, if there is one."""
        if self.state_file is None or not self.state_file.exists():
            if self.checkpoint is not None and self.checkpoint.exists():
                message = f"{str(self.checkpoint)!r} exists, but not its training state {str(self.state_file)!r}"
                raise ValueError(f"checkpoint: {message}; choose another file, or delete it to start again")
            return False
        for replay in self.replays:
            if isinstance(replay, LanguageWorldExperienceReplay):
                replay.verify()
        begin, stamp = f"checkpoint: {str(self.state_file)!r}", self._stamp()
        description, stored = read_file(self.state_file, "training")
        check_same_description(self.state_file, description, self.described)
        if self.part is not None and self.checkpoint is not None and self.checkpoint.exists():
            own = {self.part: self.described[self.part]}
            check_same_description(self.checkpoint, read_file(self.checkpoint, self.part)[0], own)
        if (before := description["device"]) != self.device.type:
            warnings.warn(
                f"{begin} was trained on {before!r} and resumes on {self.device.type!r}: training continues with the "
                "same minibatches, but results will not be bit-identical to an uninterrupted run",
                stacklevel=3,
            )
        warn_of_other_versions(self.state_file, description["versions"], LIBRARIES)
        try:
            state = pop_state(description, stored)
            copy_tensors(stored, self.contents())
            self.load_state_dict(state)
            self._last_stamp = stamp
        except (ValueError, KeyError, TypeError, RuntimeError) as error:
            message = f"{begin} does not fit, it is damaged or of another architecture"
            raise ValueError(f"{message} ({short_message(error)})") from error
        return True

    def state_dict(self) -> dict[str, Any]:
        """Return all that training resumes from, except the weights."""
        assert self.schedule is not None
        return {
            "optimizer": self.optimizer.state_dict(),
            "schedule": self.schedule.state_dict(),
            "states": [state.state_dict(self.steps) for state in self.states],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        assert self.schedule is not None
        for own, stored in zip(self.states, state["states"], strict=True):
            own.load_state_dict(stored)
        self.optimizer.load_state_dict(state["optimizer"])
        self.schedule.load_state_dict(state["schedule"])
        self.steps = state["states"][0]["step"]


def make_schedule(name: str, optimizer: torch.optim.Optimizer, steps: int) -> Schedule:
    """Return the schedule of the learning rate: "cosine", to 0 after ``steps`` steps, or "constant"."""
    if name == "cosine":
        return torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    return torch.optim.lr_scheduler.LambdaLR(optimizer, lambda _: 1.0)


class Interrupt:
    """Whether Ctrl-C was pressed, once or again."""

    asked = insisted = False


@contextmanager
def interrupts_between_steps() -> Iterator[Interrupt]:
    """Let the first Ctrl-C only set ``asked``, and raise :class:`KeyboardInterrupt` at the end of the block.

    A second Ctrl-C raises at once. Nothing changes outside the main thread, or where SIGINT is ignored.
    """
    interrupt = Interrupt()
    before = signal.getsignal(signal.SIGINT) if threading.current_thread() is threading.main_thread() else None
    if not callable(before):
        yield interrupt
        return

    def ask(number: int, frame: FrameType | None) -> None:
        interrupt.insisted, interrupt.asked = interrupt.asked, True
        if interrupt.insisted:
            before(number, frame)

    signal.signal(signal.SIGINT, ask)
    try:
        yield interrupt
    except Exception as error:
        if interrupt.insisted:  # within a step it may come out as another error: losses catch what tensordicts raise
            raise KeyboardInterrupt from error
        raise
    finally:
        signal.signal(signal.SIGINT, before)
    if interrupt.asked:
        raise KeyboardInterrupt
