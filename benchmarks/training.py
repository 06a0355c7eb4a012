"""Benchmarks of a behavioral cloning step, on each available device and with torch.compile."""

from __future__ import annotations

import warnings
from time import perf_counter

import torch
from tensordict import TensorDict
from torchrl.objectives import BCLoss

import lw_torchrl as lw
from benchmarks.report import Row, Settings, compare, take_turns, under

BATCH = 500


def _batch() -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    observation = torch.randn((BATCH, 39), generator=generator)
    task_id = torch.arange(BATCH) % len(lw.MT50)
    action = torch.rand((BATCH, 4), generator=generator) * 2 - 1
    batch = TensorDict({"observation": observation, "task_id": task_id, "action": action}, [BATCH])
    return lw.QAFTransform(lw.load_plans("MT50"))(batch)


class _Learner:
    """An actor with the loss and optimizer of BehavioralCloningTrainer."""

    def __init__(self, batch: TensorDict, *, compiled: bool = False, device: str = "cpu") -> None:
        torch.manual_seed(0)
        actor = lw.PlanConditionedActor(lw.load_plans("MT50")).to(device)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*target_actor_network_params.*")
            self._module = BCLoss(actor, loss_function="l2")
        self._loss = torch.compile(self._module) if compiled else self._module
        self._optimizer = torch.optim.AdamW(self._module.parameters(), lr=1e-3)
        self._batch = batch.to(device)

    def __call__(self) -> None:
        loss = self._loss(self._batch)["loss_bc"]
        self._optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self._module.parameters(), 1.0)
        self._optimizer.step()


def _devices() -> dict[str, str]:
    """Return the name to print for each available device."""
    gpus = {f"cuda:{number}": torch.cuda.get_device_name(number) for number in range(torch.cuda.device_count())}
    return {"cpu": "CPU", **gpus, **({"mps": "MPS"} if torch.backends.mps.is_available() else {})}


def _on(batch: TensorDict, device: str, steps: int) -> float:
    """Return the mean seconds of a step, with a single synchronization at the end."""
    step = _Learner(batch, device=device)
    for _ in range(3):
        step()
    wait = (lambda: None) if device == "cpu" else lambda: torch.accelerator.synchronize(torch.device(device))
    wait()
    start = perf_counter()
    for _ in range(steps):
        step()
    wait()
    return (perf_counter() - start) / steps


def train_step(settings: Settings) -> list[Row]:
    """Train PlanConditionedActor with BCLoss on batches of 500 rows of all 50 tasks."""
    batch = _batch()
    name = f"training step, batch {BATCH}"
    steps = settings.pick(100, 2)
    rows = [under(f"{name}, {called}", 1e3 * _on(batch, there, steps), "ms") for there, called in _devices().items()]
    if not settings.compiled or settings.quick:
        return rows
    eager, compiled = _Learner(batch), _Learner(batch, compiled=True)
    start = perf_counter()
    compiled()
    waited = perf_counter() - start
    found = take_turns({"compiled": compiled, "eager": eager}, 50, warm_up=5)
    return [
        *rows,
        compare(
            f"{name}, torch.compile",
            found["compiled"],
            "eager",
            found["eager"],
            unit="ms",
            scale=1e3,
            note=f"after {waited:.0f} s of compiling",
        ),
    ]
