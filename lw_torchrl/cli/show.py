"""The subcommands of ``lw-torchrl`` that show something: the demo, a recording, the answers in a state."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from lw_torchrl.cli.outputs import check_file, check_folder
from lw_torchrl.cli.sources import read_tasks, simulated
from lw_torchrl.cli.tables import Output
from lw_torchrl.cli.threads import use_one_thread


def demo(out: Path | None = None, quick: bool = False, json: bool = False) -> Output:
    """Train a plan-conditioned policy on MT10 and show it: demonstrations, training, evaluation, a recording.

    Takes some minutes on two cores. Stopped and started again it carries on.

    Args:
        out: folder for results.json, success.png, rollout.rrd, checkpoint.zip and config.json; runs/demo, or
            runs/demo-quick with --quick.
        quick: two tasks and little training, in under a minute; not a measure of anything.
        json: print one JSON document instead, see docs/cli.md.
    """
    folder = check_folder("--out", out or Path("runs/demo-quick" if quick else "runs/demo"))
    from lw_torchrl.paper.demo import QUICK, DemoConfig, run_demo

    use_one_thread()
    result = run_demo(folder, QUICK if quick else DemoConfig())
    output = Output(json)
    if json:  # as text it has printed itself
        output.result(result)
    return output


def view(
    recording: Positional[Annotated[Path, arg(metavar="RUN|FILE")]],
    /,
    episode: str | None = None,
    screenshot: Path | None = None,
    step: int | None = None,
    window_size: str = "1400x900",
    html: Path | None = None,
    web: bool = False,
    port: int = 0,
) -> None:
    """Open a recording in the rerun viewer; or take a picture of it, write it as one page, or serve it as one.

    Example: lw-torchrl view runs/demo --episode drawer-open --screenshot picture.png --step 80

    Args:
        recording: an .rrd file, or a folder that holds one.
        episode: open at this tab, by its title or its episode's name.
        screenshot: write a .png here and open no window; wants Debian's mesa-vulkan-drivers and libvulkan1.
        step: the step to open at; if none is given, the one that tells most, of a training the last.
        window_size: of the picture or the window, WIDTHxHEIGHT.
        html: write one self-contained page here, some 20 MB, that opens from disk in a browser.
        web: serve a page on this machine and print its address, until Ctrl-C.
        port: of the page; 0 takes a free one.
    """
    given = [f"--{name}" for name, value in (("screenshot", screenshot), ("html", html), ("web", web)) if value]
    if len(given) > 1:
        raise ValueError(f"give one of --screenshot, --html and --web, got {' and '.join(given)}")
    for option, file, ending in (("--screenshot", screenshot, ".png"), ("--html", html, ".html")):
        if file is not None:
            check_file(option, file, ending)
    if not re.fullmatch(r"[1-9]\d*x[1-9]\d*", window_size):
        raise ValueError(f"window_size must be like '1400x900', got {window_size!r}")
    if not recording.exists():
        raise FileNotFoundError(f"recording: there is no file or folder {str(recording)!r}")
    if recording.is_dir() and not any(recording.glob("*.rrd")):
        raise FileNotFoundError(f"recording: the folder {str(recording)!r} holds no recording (*.rrd)")
    from lw_torchrl.record import WebPage, open_viewer, write_html

    if web:
        with WebPage(recording, episode=episode, step=step, port=port) as page:
            print(f"{page.address}  (Ctrl-C ends it)", flush=True)
            with suppress(KeyboardInterrupt):
                page.serve()
        return
    if html is not None:
        write_html(recording, html, episode=episode, step=step)
    else:
        open_viewer(recording, screenshot, window_size, step=step, episode=episode)
    if written := html or screenshot:
        print(f"written to {written}")


def query(
    task: Positional[Annotated[str, arg(metavar="TASK")]],
    text: Positional[Annotated[str | None, arg(metavar="[TEXT]")]] = None,
    /,
    step: int = 0,
    seed: int = 0,
    episode: int = 0,
    task_file: Path | None = None,
    json: bool = False,
) -> Output:
    """Answer a query on a state of a task: the state after so many steps of the scripted expert.

    Example: lw-torchrl query pick-place "Is the gripper open and not above the puck?" --step 40

    Args:
        task: a task's name.
        text: the query; without one, all supported queries that hold are listed.
        step: how many steps the expert does first, 0 to 500.
        seed: of the episode.
        episode: its index.
        task_file: tasks of yours, whose objects and points the query may name.
        json: print one JSON document instead, see docs/cli.md.
    """
    import lw_torchrl as lw
    from lw_torchrl._checks import check_int
    from lw_torchrl.language.tasks import check_task

    known = read_tasks(task_file)
    (name,) = simulated("task", [check_task(task, known)], known)
    definition = known[name]
    listed = (
        [lw.parse_query(text, definition)]
        if text is not None
        else [lw.parse_query(q, definition) for q in lw.supported_queries(definition)]
    )
    if check_int("step", step, minimum=0) > 500:
        raise ValueError(f"step must be at most 500, got {step}")
    env = lw.LanguageWorldEnv(name, seed=seed)
    state = env.reset(episode=episode)
    if step:
        state = env.rollout(step, lw.ExpertActor(name), auto_reset=False, tensordict=state)[:, -1]["next"]
    truths = lw.QueryProgram({definition: listed})(state["observation"], state["task_id"])[0].tolist()
    env.close()
    output = Output(json)
    positions = {place: at.tolist() for place, at in definition.positions(state["observation"][0]).items()}
    lines = [f"the {place:24} at {' '.join(f'{x:7.3f}' for x in at)} m" for place, at in positions.items()]
    output.show("positions", positions, "\n".join(lines))
    opening = state["observation"][0, 3].item()
    output.show("opening", opening, f"the gripper's opening       {opening:7.3f}\n")
    answers = [{"query": str(found), "holds": truth} for found, truth in zip(listed, truths, strict=True)]
    if text is not None:
        said = [f"{'yes' if one['holds'] else 'no'}: {one['query']}" for one in answers]
    else:
        said = [one["query"] for one in answers if one["holds"]]
    output.show("queries", answers, "\n".join(said))
    return output
