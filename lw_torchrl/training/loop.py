"""The training loop shared by all trainers: optimizer steps, logging, evaluation, and resumable checkpoints."""

from __future__ import annotations

import math
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from types import FrameType, SimpleNamespace
from typing import Any, TypedDict

import torch
from torch import Tensor, nn
from torch.nn.utils import clip_grad_norm_
from torchrl.record.loggers import Logger

from lw_torchrl._util.checks import Count, check_value, typed
from lw_torchrl._util.devices import CPU
from lw_torchrl._util.files import AnyPath
from lw_torchrl._util.progress import Progress
from lw_torchrl.training.captured import CapturedFunction, captures, foreign_code
from lw_torchrl.training.checkpoint import CheckpointFiles, contents_of, not_finite
from lw_torchrl.training.minibatches import Minibatches
from lw_torchrl.training.normalization import share_contacts

READ_EVERY = 100
"""Number of optimizer steps between transfers of the losses to the CPU; each transfer waits for the device."""


def make_optimizer(
    rates: Iterable[tuple[Iterable[Tensor], float]], config: Any, device: torch.device
) -> torch.optim.Optimizer:
    """Create the optimizer that the config selects, with a separate learning rate for each parameter group.

    On a CUDA device the learning rates are tensors, so that a CUDA graph can capture the optimizer step.
    """
    on_gpu = captures(device)
    groups: list[dict[str, Any]] = []
    for parameters, rate in rates:
        initial = float(rate)
        lr = torch.tensor(initial, device=device) if on_gpu else initial
        groups.append({"params": list(parameters), "lr": lr, "initial_lr": initial})
    groups = [group for group in groups if group["params"]]
    if getattr(config, "optimizer", "adamw") == "sgd":
        return torch.optim.SGD(groups, momentum=config.momentum, weight_decay=config.weight_decay, fused=True)
    return torch.optim.AdamW(groups, weight_decay=config.weight_decay, fused=True, capturable=on_gpu)


def _rate_factor(config: Any, step: int) -> float:
    """Return the factor of the learning rate after ``step`` optimizer steps: 1, or on a cosine schedule from 1 to 0."""
    if getattr(config, "schedule", "cosine") == "constant":
        return 1.0
    return 0.5 * (1.0 + math.cos(math.pi * step / config.steps))


def _set_learning_rates(optimizer: torch.optim.Optimizer, config: Any, step: int) -> None:
    """Set the learning rates to their values after ``step`` optimizer steps."""
    for group in optimizer.param_groups:
        rate = group["initial_lr"] * _rate_factor(config, step)
        if isinstance(group["lr"], Tensor):
            group["lr"].fill_(rate)
        else:
            group["lr"] = rate


def _check_loss(losses: Tensor, step: int) -> None:
    """Raise :class:`ValueError` if a loss, () for one actor or (M,) for M actors, is not finite."""
    for number, loss in enumerate(losses.reshape(-1).tolist()):
        if not math.isfinite(loss):
            which, cause = f" of actor {number}" * losses.ndim, "hold NaN, or learning_rate is too high"
            raise ValueError(f"the loss{which} is {loss} at step {step}: the demonstrations {cause}")


@contextmanager
def _interrupts_between_steps() -> Iterator[SimpleNamespace]:
    """Record the first Ctrl-C as ``requested``, and raise :class:`KeyboardInterrupt` only at the end of the block.

    A second Ctrl-C (``insisted``) raises immediately. Nothing changes outside the main thread, or if SIGINT is ignored.
    """
    interrupt = SimpleNamespace(requested=False, insisted=False)
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
        if interrupt.insisted:  # tensordict may have converted the KeyboardInterrupt to another error
            raise KeyboardInterrupt from error
        raise
    finally:
        signal.signal(signal.SIGINT, previous)
    if interrupt.requested:
        raise KeyboardInterrupt


class TrainingOptions(TypedDict, total=False):
    """The keyword arguments that every trainer accepts; see :class:`Training`."""

    checkpoint: AnyPath | None
    evaluate: Callable[[], Mapping[str, float]] | None
    evaluate_every: int | None
    logger: Logger | None
    progress: bool
    title: str
    capture: bool | None


class Training:
    """Base class for trainers. A subclass sets the attributes below and implements :meth:`losses`.

    Args:
        config: hyperparameters ``steps``, ``checkpoint_every``, ``learning_rate``, and optionally ``schedule``
            ("cosine" or "constant") and ``max_grad_norm``.
        checkpoint: the file to write the trained policy to, for example "mt10.safetensors". The training state is
            written next to the policy ("mt10.training.safetensors"). Training resumes from an existing training state.
        evaluate: a function that returns numbers to log as ``evaluation/NAME``, such as success on held-out seeds.
        evaluate_every: call ``evaluate`` every N minibatches and after the last, with the networks in eval mode.
        logger: a TorchRL logger, which receives the mean losses of every 100 minibatches as ``train/NAME``.
        progress, title: whether to show a progress bar, and the title of the progress bar.
        capture: run the training step on a CUDA device as one CUDA graph, which repeats the kernels of the third step
            without running Python. None captures steps of modules from torch, torchrl, tensordict and this library;
            True also captures other classes, which must not change Python attributes from step to step. If a step
            cannot be captured, a warning says why, and training continues without a graph.

    Attributes:
        module, optimizer: the module that contains all trained parameters, and their optimizer.
        networks, device: the networks (in train mode during training, in eval mode afterwards), and their device.
        minibatches: the sources of minibatches, one for each buffer.
        description: a JSON description of the training. Training resumes only from a state with an equal description.
        part: the content of ``checkpoint``, "actor" or "evaluator"; None if ``checkpoint`` is the training state.
        steps, last: the number of minibatches so far, and the mean losses of the latest 100 minibatches, by name.

    Warns:
        UserWarning: training resumes, but not bit-exactly, for example on another device type or torch version.

    Raises:
        ValueError: the checkpoint is corrupted, or has another architecture, config or dataset; or a loss or weight is
            NaN or infinite.
        OSError: the checkpoint cannot be written; the existing checkpoint is kept.
    """

    part: str | None = None
    module: nn.Module
    networks: list[nn.Module]
    optimizer: torch.optim.Optimizer
    device = CPU

    @typed
    def __init__(
        self,
        config: Any,
        *,
        checkpoint: AnyPath | None = None,
        evaluate: Callable[[], Mapping[str, float]] | None = None,
        evaluate_every: Count | None = None,
        logger: Logger | None = None,
        progress: bool = True,
        title: str = "training",
        capture: bool | None = None,
    ) -> None:
        if (evaluate is None) != (evaluate_every is None):
            raise ValueError("evaluate and evaluate_every must be given together")
        self.config, self.logger, self.progress, self.title = config, logger, progress, title
        self.evaluate, self.evaluate_every, self.checkpoint = evaluate, evaluate_every, checkpoint
        self._files = None if checkpoint is None else CheckpointFiles(checkpoint, self.part)
        self.steps, self.last, self.description = 0, dict[str, float](), dict[str, Any]()
        self.minibatches: list[Minibatches] = []
        self._values: deque[dict[str, Tensor]] = deque(maxlen=READ_EVERY)
        self.capture = capture
        self._captured: CapturedFunction | None = None

    def losses(self, batch: Any) -> Mapping[str, Tensor]:
        """Return the loss terms of a minibatch, and other values to log, by name. Values whose names begin with "loss"
        are summed."""
        raise NotImplementedError(f"{type(self).__name__} must implement losses")

    def step(self) -> Tensor:
        """Train on one minibatch and return the loss, () float32, or (M,) for M models, without waiting for the device.

        The first of :attr:`minibatches` seeds the random numbers of the networks.
        """
        first, *others = self.minibatches
        drawn = []
        for minibatches in others:
            with minibatches.drawing(self.device):
                drawn.append(minibatches.draw())
        with first.drawing(self.device):
            values = self._run(self.combined([first.draw(), *drawn]))
        self.steps += 1
        _set_learning_rates(self.optimizer, self.config, self.steps)
        self._values.append(values)
        return values["loss"]

    def _run(self, drawn: Any) -> dict[str, Tensor]:
        """Run :meth:`update` on drawn minibatches; on a CUDA device, run it as one CUDA graph."""
        if self._captured is None:
            self._captured = captured = CapturedFunction(lambda each: self.update(self.batch(each)), self.device)
            captured.tries &= self.capture is not False
            transforms = (getattr(each.source, "transform", None) for each in self.minibatches)
            parts = [self, self.module, *self.networks, *transforms]
            if self.capture is None and captured.tries and (name := foreign_code(parts)):
                captured.give_up(f"{name} may change its attributes from step to step; if not, use capture=True")
        return self._captured(drawn, tuple(network.training for network in self.networks))

    def combined(self, drawn: list[Any]) -> Any:
        """Combine the draws from all :attr:`minibatches`."""
        (only,) = drawn
        return only

    def batch(self, drawn: Any) -> Any:
        """Return the minibatch for ``drawn``, the result of :meth:`combined` after a move to the device."""
        return self.minibatches[0].rows(drawn)

    def update(self, batch: Any) -> dict[str, Tensor]:
        """Run one optimizer step and return the detached values to log.

        This method contains all work on the device. On a GPU no value is read back and no shape depends on data, so
        that a CUDA graph can capture the method.
        """
        values = dict(self.losses(batch))
        terms = [value for name, value in values.items() if name.startswith("loss")]
        values["loss"] = loss = terms[0] if len(terms) == 1 else torch.stack(terms).sum(0)
        if self.device == CPU:  # on a GPU, reading the loss would wait for the device
            _check_loss(loss.detach(), self.steps)
        self.optimizer.zero_grad()
        loss.sum().backward()
        self.clip_gradients()
        self.optimizer.step()
        self.after_update()
        return {name: value.detach() for name, value in values.items() if name == "loss" or value.numel() == 1}

    def clip_gradients(self) -> None:
        """Clip the gradients of each parameter group before the optimizer step."""
        if (norm := getattr(self.config, "max_grad_norm", None)) is not None:
            for group in self.optimizer.param_groups:
                clip_grad_norm_(group["params"], norm)

    def after_update(self) -> None:
        """Run after each optimizer step, for example to update target networks; does nothing by default."""

    @property
    def saved(self) -> nn.Module:
        """The policy or evaluator that is written to ``checkpoint``."""
        return self.module

    def parameters(self) -> dict[str, Tensor]:
        """Return the trained parameters by name."""
        return dict(self.module.named_parameters())

    def contents(self) -> dict[str, Tensor]:
        """Return the tensors that a training state stores: weights, buffers and text vectors."""
        return contents_of(self.module)

    def run(self, until: int | None = None) -> Tensor:
        """Train like :meth:`train`, but return the latest 100 losses, (n,) or (n, M) float32, on the CPU."""
        total = self.config.steps
        if until is not None and check_value("until", until, Count) > total:
            raise ValueError(f"until must be at most config.steps = {total}, got {until}")
        self._values.clear()
        self._set_training(True)
        last = total if until is None else until
        lock = nullcontext() if self._files is None else self._files.locked()
        with lock, _interrupts_between_steps() as interrupt:
            with Progress(self.title, total, "step", initial=self.steps, show=self.progress) as bar:
                if self.steps >= last:
                    self.save()  # an earlier process may have been killed between writing the state and the policy
                while self.steps < last and not interrupt.requested:
                    self.step()
                    bar.update()
                    self._report(bar, done=self.steps == last)
            if interrupt.requested:
                self._read_losses()
                self.save()
        self._set_training(False)
        return self._read_losses()

    def train(self, until: int | None = None) -> float:
        """Train on the remaining minibatches and return the mean of the latest 100 losses; NaN if none remained.

        Ctrl-C finishes the current minibatch, saves a checkpoint and stops; a second Ctrl-C stops immediately.

        Args:
            until: save a checkpoint and stop after N minibatches in total; a later call continues. None for all.
        """
        losses = self.run(until)
        return losses.double().mean().item() if len(losses) else math.nan

    def _report(self, bar: Progress, done: bool) -> None:
        """Log, save and evaluate after a minibatch, if logging, saving or evaluation is due."""
        logs, saves = (done or self.steps % every == 0 for every in (READ_EVERY, self.config.checkpoint_every))
        if logs or saves:
            self._read_losses()
        if logs:
            rate = self.optimizer.param_groups[0]["initial_lr"] * _rate_factor(self.config, self.steps)
            self._log("train", {**self.last, "learning_rate": rate})
            bar.note(**{name: f"{value:.4f}" for name, value in self.last.items() if "loss" in name})
        if saves:
            self.save()
        if self.evaluate is not None and self.evaluate_every and (done or self.steps % self.evaluate_every == 0):
            self._set_training(False)
            self._log("evaluation", self.evaluate())
            self._set_training(True)

    def _log(self, group: str, values: Mapping[str, float]) -> None:
        if self.logger is not None:
            for name, value in values.items():
                self.logger.log_scalar(f"{group}/{name}", value, step=self.steps)

    def _set_training(self, training: bool) -> None:
        for network in self.networks:
            network.train(training)

    def _read_losses(self) -> Tensor:
        """Wait for the device, update ``last`` and return the latest losses; raise ValueError if any is not finite."""
        if not self._values:
            return torch.empty(0)
        names = [name for name in self._values[0] if all(name in values for values in self._values)]
        read = {name: torch.stack([values[name] for values in self._values]).cpu() for name in names}
        self.last = {name: value.double().mean().item() for name, value in read.items()}
        for step, loss in enumerate(read["loss"], self.steps - len(self._values)):
            _check_loss(loss, step)
        return read["loss"]

    def save(self) -> None:
        """Check that all weights are finite, then write the checkpoint files atomically if ``checkpoint`` is set."""
        if bad := not_finite(self.parameters()):
            raise ValueError(f"weights: {bad[0]} is NaN or infinite after step {self.steps}; try a lower learning rate")
        if self._files is not None:
            part = self.saved if self.part else None
            self._files.write(self.description, self.device, self.contents(), self.state_dict(), part)

    def resume(self) -> bool:
        """Resume from the training state and return True if it exists; otherwise return False."""
        if self._files is None or not self._files.exist():
            return False
        for minibatches in self.minibatches:
            getattr(minibatches.source, "verify", lambda: None)()  # the dataset's rows must match their checksums
        self._files.restore(self.description, self.device, self.contents(), self.load_state_dict)
        for network in self.networks:
            share_contacts(network)
        return True

    def state_dict(self) -> dict[str, Any]:
        """Return the state needed to resume training, except the weights."""
        minibatches = [each.state_dict() for each in self.minibatches]
        return {"step": self.steps, "optimizer": self.optimizer.state_dict(), "minibatches": minibatches}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state returned by :meth:`state_dict`."""
        for minibatches, stored in zip(self.minibatches, state["minibatches"], strict=True):
            minibatches.load_state_dict(stored)
        rates = [group["lr"] for group in self.optimizer.param_groups]
        self.optimizer.load_state_dict(state["optimizer"])
        for group, rate in zip(self.optimizer.param_groups, rates, strict=True):
            group["lr"] = rate  # on a GPU, keep the optimizer's GPU tensor instead of the state's CPU tensor
        self._captured = None  # a CUDA graph would use the old state
        self.steps = state["step"]
        _set_learning_rates(self.optimizer, self.config, self.steps)
