"""The command ``lw-torchrl info`` without arguments: describe the installation and the machine for a bug report."""

from __future__ import annotations

import importlib.util
import os
import platform
import re
import tempfile
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Any

import torch

from lw_torchrl._util.workers import available_cores
from lw_torchrl.cli.options import Output
from lw_torchrl.language.query_program import find_kernel
from lw_torchrl.suites.cameras import Cameras

_PACKAGES = ("lw_torchrl", "torch", "torchrl", "tensordict", "mujoco", "metaworld", "numpy", "rerun-sdk")
_VARIABLES = (
    "OMP_NUM_THREADS", "CUDA_VISIBLE_DEVICES", "MUJOCO_GL", "NUMBA_CACHE_DIR", "NUMBA_DISABLE_JIT", "HF_HOME",
    "TORCHINDUCTOR_CACHE_DIR",
)  # fmt: skip


def describe_machine(output: Output) -> Output:
    """Print the versions, cores, extras and cache folders, and the causes of slow speed on this machine."""
    slow = find_slow_parts()
    extras = {name: f"missing: {', '.join(of)}" if of else "installed" for name, of in find_extras().items()}
    sections = {
        "versions": {"python": platform.python_version(), **{name: find_version(name) for name in _PACKAGES}},
        "machine": _machine(),
        "extras": extras,
        "cache folders": _cache_folders(),
        "variables": {name: os.environ[name] for name in _VARIABLES if name in os.environ},
    }
    for title, values in sections.items():
        width = max(map(len, values), default=0)
        lines = [f"  {name:{width}}  {value}" for name, value in values.items()]
        output.show(title.replace(" ", "_"), values, "\n".join([f"{title}:", *(lines or ["  none"]), ""]))
    return output.show("slow", slow, "\n".join(["slow here:", *(f"  - {text}" for text in slow or ["nothing known"])]))


def find_version(package: str) -> str:
    """Return the version of an installed package, or "missing"."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "missing"


def find_extras() -> dict[str, list[str]]:
    """Return a dict from each extra of lw_torchrl to the packages of that extra that are not installed."""
    extras: dict[str, list[str]] = {}
    try:
        lines = requires("lw_torchrl") or []
    except PackageNotFoundError:  # lw_torchrl is on the path, but not installed
        return {}
    for line in lines:
        if (match := re.match(r"([\w.-]+).*\bextra == ['\"]([\w-]+)['\"]", line)) and match[2] != "dev":
            missing = extras.setdefault(match[2], [])
            if find_version(match[1]) == "missing":
                missing.append(match[1])
    return extras


def find_slow_parts() -> list[str]:
    """Return a list of sentences, each with a reason why the library is slow on this machine and a remedy, if any."""
    cores, slow = available_cores(), []
    if find_kernel() is None:
        if importlib.util.find_spec("numba") is None:
            slow.append("Conditions and the simulation are not compiled: pip install 'lw_torchrl[fast]'.")
        else:
            slow.append("Numba has no writable cache folder: set NUMBA_CACHE_DIR to a writable folder.")
    elif os.environ.get("NUMBA_DISABLE_JIT", "0") != "0":
        slow.append("NUMBA_DISABLE_JIT is set, so conditions and the simulation are not compiled; unset the variable.")
    if cores == 1:
        slow.append("There is only one core: simulation, collection and evaluation use one thread per core.")
    if (total := os.cpu_count() or 1) > cores:
        slow.append(f"This process may use {cores} of the machine's {total} cores (affinity or a job's limit).")
    if hasattr(os, "getloadavg") and (load := os.getloadavg()[0]) > cores + 1:
        slow.append(f"Other programs are using the cores: the load is {load:.1f} on {cores} cores.")
    if (accelerator := torch.accelerator.current_accelerator(check_available=True)) is None:
        slow.append("This PyTorch finds no GPU: networks train on the CPU. The simulation always runs on the CPU.")
    else:
        slow.append(f"The simulation runs on the CPU, not on the GPU ({accelerator}): more cores make it faster.")
    return slow


def _machine() -> dict[str, str]:
    images = "yes"
    try:
        Cameras().close()
    except ImportError as error:
        images = f"no: {error}"
    gpus = [torch.cuda.get_device_name(number) for number in range(torch.cuda.device_count())]
    build = f"PyTorch built with CUDA {torch.version.cuda}" if torch.version.cuda else "PyTorch built without CUDA"
    return {
        "system": platform.platform(),
        "cores": f"{available_cores()} of {os.cpu_count()}",
        "gpu": f"{', '.join(gpus) or 'none'} ({build})",
        "numba": f"{find_version('numba')} ({'in use' if find_kernel() else 'not in use'})",
        "camera images": images,
    }


def _cache_folders() -> dict[str, str]:
    user = Path.home() / ".cache"
    inductor = Path(tempfile.gettempdir()) / f"torchinductor_{os.environ.get('USER', 'root')}"
    folders: dict[str, Any] = {
        "Numba": os.environ.get("NUMBA_CACHE_DIR") or Path(__file__).parents[1] / "language" / "__pycache__",
        "torch.compile": os.environ.get("TORCHINDUCTOR_CACHE_DIR") or inductor,
        "Hugging Face": os.environ.get("HF_HOME") or user / "huggingface",
        "language models' answers": Path("runs/answers"),
    }
    described = {}
    for name, path in ((name, Path(path)) for name, path in folders.items()):
        shown = str(path).replace(str(Path.home()), "~", 1) if path.is_relative_to(Path.home()) else str(path)
        unusable = " (not writable)" if path.is_dir() else " (does not exist yet)"
        described[name] = shown + ("" if os.access(path, os.W_OK) else unusable)
    return described
