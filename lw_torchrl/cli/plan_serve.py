"""``lw-torchrl plan serve``: a language model on this machine, for the other commands to ask."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg


def serve(
    model: Positional[Annotated[Path | None, arg(metavar="[MODEL.gguf]")]] = None,
    /,
    host: str = "127.0.0.1",
    port: int = 8000,
    context: int = 8192,
    threads: int | None = None,
) -> None:
    """Serve a language model on this machine, as OpenAI's servers do, until Ctrl-C. It wants the extra [serve].

    The extra brings a small model, so that everything can be tried without a key: held to a schema it writes plans that
    run, hardly ones that succeed. Larger ones are GGUF files, which https://huggingface.co has by the thousand.

    Example: lw-torchrl plan serve Llama-3.2-3B-Instruct-Q4_K_M.gguf --port 8001

    Args:
        model: a GGUF file; the small model of the extra if none is given.
        host: the address to listen at; by default this machine alone is heard. There is no key.
        port: where; 0 takes a free one.
        context: tokens of a question and its answer, at most.
        threads: of the processor; half of its cores if none is given.
    """
    from lw_torchrl.planners.model_server import model_file, serve_model

    file = model_file(model)
    print(f"loading {file}", flush=True)

    def ready(name: str, address: str) -> None:
        print(f"{name} is served at {address}; Ctrl-C ends it. In another terminal:")
        print(
            f"lw-torchrl plan generate MT10 --model {name} --base-url {address} --constrain --format basic_py",
            flush=True,
        )

    serve_model(file, host=host, port=port, context=context, threads=threads, ready=ready)
