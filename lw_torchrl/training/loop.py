"""Training: the loop of all trainers, with progress, logs, Ctrl-C, and checkpoints that training resumes from."""

from __future__ import annotations

import signal
import threading
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
from lw_torchrl._files import AnyPath, held, sweep
from lw_torchrl._progress import Progress
from lw_torchrl._tensor_archive import check_like, check_optimizer_state, check_same
from lw_torchrl._versions import LIBRARIES
from lw_torchrl.data.replay import LanguageWorldExperienceReplay
from lw_torchrl.training.envelope import Envelope
from lw_torchrl.training.file_checks import check_finite, text_vectors

READ_EVERY = 100
"""Steps between readings of the losses: to read one is to wait for its device."""

Schedule = torch.optim.lr_scheduler.LRScheduler


class ReplayState:
    """A training's buffer and its random draws: the buffer draws from a seed on, and so do transforms and networks."""

    def __init__(self, replay: TensorDictReplayBuffer, seed: int) -> None:
        self.replay, self.generator = replay, torch.Generator().manual_seed(seed)
        replay.set_rng(self.generator)
        self.torch_generator = self.generator.get_state()

    @contextmanager
    def drawing(self, device: torch.device) -> Iterator[None]:
        """Within the block the global generators are this training's own."""
        with drawn_on(device, self.torch_generator):
            yield
            self.torch_generator = torch.get_rng_state()

    def minibatch(self, size: int, device: torch.device) -> TensorDictBase:
        """A minibatch on the device; if the buffer's rows are elsewhere, it is copied there."""
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
        """Go on from what :meth:`state_dict` gave; :class:`ValueError` if it is not of such a buffer."""
        sampler, ours = state.get("sampler"), self.replay.sampler
        check_like({**state, "sampler": None}, {**self.state_dict(0), "sampler": None}, "state")
        if not isinstance(sampler, dict) or set(sampler) != set(ours.state_dict()):
            raise ValueError(f"state must have a sampler's state, one of a {type(ours).__name__}")
        torch.Generator().set_state(state["torch_generator"].clone())
        self.generator.set_state(state["generator"].clone())
        self.torch_generator = state["torch_generator"].clone()
        if sampler:
            ours.load_state_dict(sampler)


class TrainingOptions(TypedDict, total=False):
    """The options of :class:`Training` that every trainer takes."""

    checkpoint: AnyPath | None
    logger: Logger | None
    progress: bool
    title: str


class Training:
    """What all trainers share. A subclass makes ``optimizer`` and ``module``, and fills in :meth:`step`.

    Args:
        config: how to train, with ``steps``, ``checkpoint_every`` and ``learning_rate``; None for the defaults.
        replays: the buffers. Their generators are set to the configuration's seed.
        checkpoint: a file to write checkpoints to. If it is there already, training carries on from it.
        logger: a TorchRL logger for what :meth:`means` gives, every 100 steps.
        progress, title: show a progress bar, and its title.

    Attributes:
        module: holds all that is trained.
        steps: the minibatches done.
        states: of the buffers, one each.
        networks, device: those that are in train mode while :meth:`run` lasts, and where they are.
        described: what a checkpoint says, as JSON: training resumes only from one that says the same.
        says_device: whether a checkpoint says on which kind of device it was trained.

    Warns:
        UserWarning: the checkpoint was written on another kind of device, or under other versions of torch, say:
            training goes on with the same minibatches, but not bit for bit.

    Raises:
        ValueError: the checkpoint is damaged, or of other architecture, configuration or data; a loss or weight is NaN.
        OSError: the checkpoint cannot be written; the earlier one stays.
    """

    envelope: ClassVar[Envelope]
    says_device: ClassVar[bool] = False
    module: nn.Module
    optimizer: torch.optim.Optimizer
    schedule: Schedule | None = None
    device = CPU

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
        if self.checkpoint is not None:
            sweep(self.checkpoint)
        self._file_known = self._file_now()  # it was read or written by this training

    def step(self) -> Any:
        """Find a minibatch's loss and give it to :meth:`descend`."""
        raise NotImplementedError

    def parameters(self) -> dict[str, Tensor]:
        """What is trained, by name."""
        return dict(self.module.named_parameters())

    def contents(self) -> dict[str, dict[str, Tensor]]:
        """The live tensors that a checkpoint holds, by group and name."""
        return {"weights": self.module.state_dict(keep_vars=True), "texts": text_vectors(self.module)}

    def clip_gradients(self) -> None:
        """Change the gradients before the optimizer's step."""

    def means(self, losses: Tensor) -> dict[str, float]:
        """What is logged, by name, of the last losses, (n,) or (n, M) float32 on the CPU; "loss" in a name is shown."""
        return {"loss": losses.mean().item()}

    def descend(self, losses: Tensor) -> Tensor:
        """Take an optimizer's step on the loss, () float32, or on those of M models, (M,) float32; return it, detached.
        Other devices than the CPU are not waited for: there :meth:`run` says later that a loss is no number."""
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
        """Train to the last step, or until so many in all; return the losses of the last 100 steps made, (n,) or (n, M)
        float32 on the CPU. Ctrl-C ends it between two steps, with a checkpoint."""
        total = self.config.steps
        if until is not None and check_int("until", until, minimum=1) > total:
            raise ValueError(f"until must be at most the configuration's steps, {total}, got {until}")
        self._losses.clear()
        for network in self.networks:
            network.train()
        last = total if until is None else until
        with self.at_work(total, self.steps) as (bar, interrupt):
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
        """The losses that are kept; :class:`ValueError` if one is no finite number."""
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
        """Keep other trainings from the checkpoint, show progress and take Ctrl-C between steps; :class:`ValueError` if
        another training is at work, or has written the checkpoint meanwhile."""
        bar = Progress(self.title, total, "step", initial=done, show=self.progress)
        alone = nullcontext() if self.checkpoint is None else held(self.checkpoint, "checkpoint", "training")
        with alone:
            if self._file_now() not in (None, self._file_known):
                raise ValueError(
                    f"checkpoint: {str(self.checkpoint)!r} was written by another training after this one had begun; "
                    "begin anew to go on from it, or choose another file"
                )
            with bar, interrupts_between_steps() as interrupt:
                yield bar, interrupt

    def _file_now(self) -> tuple[int, ...] | None:
        """What tells the checkpoint's file from a later one; None for no file."""
        if self.checkpoint is None or not self.checkpoint.exists():
            return None
        stat = self.checkpoint.stat()
        return stat.st_ino, stat.st_size, stat.st_mtime_ns

    def save(self) -> None:
        """Write the checkpoint, if there is to be one; an earlier one is replaced whole."""
        try:
            check_finite(self.parameters(), self.parameters())
        except ValueError as error:
            raise ValueError(f"{error} after step {self.steps}: the learning rate is too high") from error
        if self.checkpoint is not None:
            said = {"device": self.device.type} if self.says_device and self.device.type != "cpu" else {}
            self.envelope.write(self.checkpoint, self.described | said, self.contents(), self.state_dict())
            self._file_known = self._file_now()

    def resume(self, packages: Sequence[str] = LIBRARIES) -> bool:
        """Go on from the checkpoint, and say whether it is there."""
        if self.checkpoint is None or not self.checkpoint.exists():
            return False
        for replay in self.replays:
            if isinstance(replay, LanguageWorldExperienceReplay):
                replay.verify()
        device = self.device if self.says_device else None
        self.envelope.resume(
            self.checkpoint, self.described, self.contents(), self.load_state_dict, device=device, packages=packages
        )
        return True

    def state_dict(self) -> dict[str, Any]:
        """All that training resumes from, the weights aside."""
        assert self.schedule is not None
        return {
            "optimizer": self.optimizer.state_dict(),
            "schedule": self.schedule.state_dict(),
            "states": [state.state_dict(self.steps) for state in self.states],
        }

    def load_state_dict(self, found: dict[str, Any]) -> None:
        assert self.schedule is not None
        if set(found) != {"optimizer", "schedule", "states"}:
            raise ValueError(f"a training state has optimizer, schedule and states, got {', '.join(map(str, found))}")
        states, steps = found["states"], self.config.steps
        if not isinstance(states, list) or len(states) != len(self.states):
            raise ValueError(f"states must be of {len(self.states)} trainings")
        step = states[0]["step"]
        if type(step) is not int or not 0 <= step <= steps or any(one["step"] != step for one in states):
            raise ValueError(f"states must all have one step from 0 to {steps}")
        check_optimizer_state(found["optimizer"], self.optimizer, step)
        live, groups = self.schedule.state_dict(), found["optimizer"]["param_groups"]
        check_like(found["schedule"], live, "schedule")
        now = {"last_epoch": step, "_step_count": step + 1, "_last_lr": [group["lr"] for group in groups]}
        check_same(found["schedule"], {**live, **now}, "schedule", set())
        for state, one in zip(self.states, states, strict=True):
            state.load_state_dict(one)
        self.optimizer.load_state_dict(found["optimizer"])
        self.schedule.load_state_dict(found["schedule"])
        self.steps = step


def make_schedule(name: str, optimizer: torch.optim.Optimizer, steps: int) -> Schedule:
    """The schedule of the learning rate: "cosine" to 0 after so many steps, or "constant"."""
    if name == "cosine":
        return torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    return torch.optim.lr_scheduler.LambdaLR(optimizer, lambda _: 1.0)


class Interrupt:
    """Whether Ctrl-C was pressed, once or again."""

    asked = insisted = False


@contextmanager
def interrupts_between_steps() -> Iterator[Interrupt]:
    """Within the block the first Ctrl-C only sets ``asked``, and the end of the block raises
    :class:`KeyboardInterrupt`; a second does so at once. Not outside the main thread, nor where SIGINT is ignored."""
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
