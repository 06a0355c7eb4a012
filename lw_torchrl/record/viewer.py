"""Open recordings in the Rerun viewer, in a window or a browser, or take a screenshot without a display."""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import IO, Any, NamedTuple
from urllib.parse import quote

from lw_torchrl._util.checks import Natural, typed
from lw_torchrl._util.files import AnyPath, replacing, run_limited
from lw_torchrl.record.entities import EPISODE_TIMELINE
from lw_torchrl.record.own_host import LOCAL, START_SECONDS, forwarded, hidden_address
from lw_torchrl.record.rerun_logger import is_complete
from lw_torchrl.record.tabs import Tabs

PAINT_SECONDS, SETTLE_SECONDS = 0.7, 15.0
REASONS = {
    r"render context|[Nn]o (graphics|wgpu) adapter|libvulkan": "no graphics driver was found. Without a GPU, install "
    "Vulkan's loader and Mesa's software driver (Debian: apt-get install libvulkan1 mesa-vulkan-drivers)",
    r"DISPLAY is set|EventLoopError|failed to open display": "there is no display. Write an image with --screenshot, "
    "or open the viewer in a browser with --web",
}
"""A mapping from patterns in a failed viewer's output to the cause and remedy to report."""


@typed
def open_viewer(
    path: AnyPath | Sequence[AnyPath],
    screenshot: AnyPath | None = None,
    window_size: str = "1400x900",
    *,
    step: Natural | None = None,
    episode: str | None = None,
    web_port: Natural | None = None,
) -> None:
    """Open recordings in the Rerun viewer and wait until the viewer is closed, or save a screenshot of the viewer.

    A recording that was not closed, because its program was killed or is still running, is shown as far as it was
    written, with a warning.

    Args:
        path: a .rrd file, a folder of .rrd files, or several of these; the viewer lists all recordings and opens the
            last one.
        screenshot: a PNG file to write instead of opening a window.
        window_size: width and height of the window or screenshot in points, such as "1400x900".
        step: the time step to open at; None for an episode's first success or failure, or the last step of a training
            run.
        episode: the tab to open, by title ("Metrics") or episode name, in each recording that has it; None opens the
            first tab.
        web_port: serve Rerun's web viewer on this port of 127.0.0.1 until Ctrl-C, instead of opening a window, and
            print the address; 0 picks a free port. Requests for other host names are rejected. The web viewer opens at
            its own default step.

    Raises:
        FileNotFoundError: the file does not exist, or the Rerun viewer is not installed.
        ValueError: a file is not a Rerun recording, or no recording has the episode.
        RuntimeError: the viewer ended with an error; the message includes a remedy if one is known.

    Example:
        >>> open_viewer("runs/demo", screenshot="rollout.png", episode="drawer-open", step=75)  # doctest: +SKIP
    """
    from rerun.chunk import RrdReader

    paths = [path] if isinstance(path, (str, os.PathLike)) else path
    recordings = [file for place in paths for file in find_recordings(place)]
    if screenshot is not None and Path(screenshot).suffix != ".png":
        raise ValueError(f"screenshot must end in '.png', got {str(screenshot)!r}")
    if web_port is not None and (screenshot is not None or step is not None):
        raise ValueError("web_port (--web) cannot be combined with screenshot or step")
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        files: list[Path] = []
        layouts: list[Path] = []
        openings: dict[str, Opening] = {}
        unknown: list[ValueError] = []
        for number, recording in enumerate(recordings):
            files.append(stack.enter_context(readable(recording)))
            with damaged(recording):
                reader = RrdReader(files[-1])
                (known, *_), tabs, front, at = reader.recordings(), Tabs.read(reader), episode, step
                if tabs is not None and episode is not None:
                    try:
                        tabs.index(episode)
                    except ValueError as error:
                        unknown.append(error)
                        front = at = None
                openings[known.recording_id] = Opening.of(tabs, front, at)
                own_front = None if web_port is None else front  # only a blueprint can set a web viewer's front tab
                if own_front is not None:  # write a copy without the recording's blueprint, which would take precedence
                    files[-1] = folder / f"{number}.rrd"
                    ids = {"application_id": known.application_id, "recording_id": known.recording_id}
                    reader.stream().write_rrd(files[-1], **ids)
                if tabs is not None and (own_front is not None or not reader.blueprints()):  # the file was not closed
                    layouts.append(folder / f"{number}.rbl")
                    tabs.blueprint(own_front).save(known.application_id, str(layouts[-1]))
        if len(unknown) == len(files):
            raise unknown[-1]
        port = str(free_port())
        arguments: list[str | Path] = [*files, *layouts, "--port", port]
        if web_port is not None:
            address, web = hidden_address(), free_port()
            page = stack.enter_context(forwarded(web_port, (address, web)))
            data = stack.enter_context(forwarded(0, (address, int(port))))
            arguments += ["--serve-web", "--web-viewer-port", str(web), "--bind", address]
            process, output = stack.enter_context(rerun_process(*arguments))
            print(f"http://{LOCAL}:{page}/?url={quote(f'rerun+http://{LOCAL}:{data}/proxy', '')}", flush=True)
        elif screenshot is None:
            process, output = stack.enter_context(rerun_process(*arguments, "--window-size", window_size))
            with suppress(ConnectionError, TimeoutError):  # the user may have closed the window immediately
                _go_to(_connect(process, port, len(openings)), openings)
        if screenshot is None:
            with suppress(KeyboardInterrupt):
                if process.wait():
                    raise viewer_error(output)
            return
        process, output = stack.enter_context(rerun_process(*arguments, "--window-size", window_size, "--headless"))
        picture = stack.enter_context(replacing(screenshot))
        try:
            client = _connect(process, port, len(openings))
            _go_to(client, openings)
            _take_picture(client, picture.absolute())
        except (ConnectionError, TimeoutError) as error:
            time.sleep(0.5)  # the viewer takes a moment to print its error
            if process.poll() is None:
                raise RuntimeError(f"the Rerun viewer did not respond: {error}") from error
            raise viewer_error(output) from error


def find_recordings(path: AnyPath) -> list[Path]:
    """Return ``path`` itself if it is a file, or all recordings in the folder ``path``, oldest first."""
    recordings = [Path(path)] if Path(path).is_file() else [*Path(path).glob("[!.]*.rrd")]
    if not recordings:
        raise FileNotFoundError(f"no recording {str(path)!r}; pass a .rrd file or a folder of .rrd files")
    return sorted(recordings, key=lambda file: (file.stat().st_mtime, file.name))


@contextmanager
def damaged(recording: Path) -> Iterator[None]:
    """Convert any error of reading a recording, including Rerun's panics, to a :class:`ValueError`."""
    try:
        yield
    except (KeyboardInterrupt, SystemExit, MemoryError, OSError):
        raise
    except BaseException as error:
        raise ValueError(f"recording {str(recording)!r} is damaged ({type(error).__name__}: {error})") from error


@contextmanager
def readable(recording: Path) -> Iterator[Path]:
    """Yield the path of a recording, or of a repaired copy if the recording was not closed properly, because Rerun
    would wait for the rest of an incomplete file. A child process reads the file first, because Rerun trusts the sizes
    that a file declares."""
    with tempfile.TemporaryDirectory() as folder:
        file = recording
        if not is_complete(recording):
            warnings.warn(f"recording {str(recording)!r} was not closed; its readable part is shown", stacklevel=4)
            file = Path(folder) / recording.name
            _check(recording, rerun_program(), "rrd", "merge", recording, "-o", file)
        _check(recording, sys.executable, "-P", "-c", _READ, file)
        yield file


_READ = """
import sys
from rerun.chunk import RrdReader
reader = RrdReader(sys.argv[1])
for _ in reader.stream():
    pass
sys.exit(None if reader.recordings() else "it is empty")
"""


def _check(recording: Path, *command: str | Path) -> None:
    """Raise a :class:`ValueError` if a command that reads a recording fails, or exceeds its limits."""
    with damaged(recording):
        done = run_limited(command, recording.stat().st_size)
    if done.returncode:
        reason = done.stderr.decode("utf-8", "replace").strip().splitlines()[-1:]
        raise ValueError(f"recording {str(recording)!r} is damaged ({''.join(reason)})")


class Opening(NamedTuple):
    """The view in which a recording opens: a tab index, a timeline and a time step; None keeps the viewer's default."""

    tab: int | None
    timeline: str | None
    step: int | None

    @classmethod
    def of(cls, tabs: Tabs | None, episode: str | None, step: int | None) -> Opening:
        """Return the view in which the tab ``episode`` opens. If another program wrote the recording (``tabs`` is
        None), only the time step is set."""
        if tabs is None:
            return cls(None, None, step)
        number = None if episode is None else tabs.index(episode)
        return cls(number, tabs.tab(episode).timeline, tabs.opening_step(episode) if step is None else step)


def _connect(process: subprocess.Popen[bytes], port: str, recordings: int) -> Any:
    """Wait until the viewer has loaded the recordings, then return a client connected to the viewer."""
    from rerun.experimental import ViewerClient

    client: Any = None
    deadline = time.monotonic() + START_SECONDS
    while time.monotonic() < deadline and process.poll() is None:
        with suppress(ConnectionError):
            client = client or ViewerClient.connect(f"rerun+http://{LOCAL}:{port}/proxy")
            state = client.get_state()
            if len(state.recordings) >= recordings and state.active_recording and not state.loading:
                return client
        time.sleep(0.1)
    raise TimeoutError(f"the viewer did not load the recording within {START_SECONDS:g} seconds")


def _go_to(client: Any, openings: dict[str, Opening]) -> None:
    """Select tabs, set time cursors, and show the last recording. By default, a cursor is set to its timeline's last
    step."""
    recordings = {recording.store_id.rpartition(":")[2]: recording for recording in client.get_state().recordings}
    for recording_id, (tab, name, step) in openings.items():
        recording = recordings[recording_id]
        if tab is not None:
            layout = client.get_blueprint(store_id=recording.store_id).blueprint
            root = f"/container/{layout['/viewport']['ViewportBlueprint']['root_container']}"
            container = layout[root]["ContainerBlueprint"]
            if isinstance(container["contents"], list):  # otherwise there is only one tab
                container["active_tab"] = container["contents"][tab]
                client.set_blueprint(layout, store_id=recording.store_id)
        name = name or recording.current_timeline
        timeline = next((timeline for timeline in recording.timelines if timeline.name == name), None)
        if timeline is not None and timeline.end is not None:
            if step is None:  # an episode's success and reward are one step after its last row
                step = max(timeline.end - 1 if name == EPISODE_TIMELINE else timeline.end, timeline.start)
            client.set_time(name, sequence=step, play_state="paused", recording=recording.store_id)
    if len(openings) > 1:
        client.set_location(recording.location)
        client.run_command("ui.expand_blueprint_panel")  # this panel lists the recordings


def _take_picture(client: Any, picture: Path) -> None:
    """Save screenshots until two in a row are equal, which means that everything is loaded and nothing moves."""
    client.run_command("ui.toggle_top_panel")  # the panel's messages would cover the views
    before, deadline = b"", time.monotonic() + SETTLE_SECONDS
    while True:
        time.sleep(PAINT_SECONDS)
        client.save_screenshot(str(picture))
        now = picture.read_bytes()
        if (now == before and now) or time.monotonic() > deadline:
            break
        before = now
    for view in client.get_state().views:
        for report in view.reports:
            warnings.warn(f"view {view.name!r} reports: {report.summary}", stacklevel=4)


def rerun_program() -> str:
    """Return the path of the ``rerun`` executable."""
    if override := os.environ.get("RERUN_CLI_PATH"):
        return override
    package = find_spec("rerun_cli")  # running the module instead of the executable would start a second process
    if package is None or package.origin is None:
        raise FileNotFoundError("the Rerun viewer is not installed; pip install 'rerun-sdk>=0.41,<0.42'")
    name = {"win32": "rerun.exe", "darwin": "Rerun.app/Contents/MacOS/Rerun"}.get(sys.platform, "rerun")
    return str(Path(package.origin).parent / name)


def free_port() -> int:
    """Return a free TCP port on this machine."""
    with socket.socket() as free:
        free.bind((LOCAL, 0))
        return int(free.getsockname()[1])


@contextmanager
def rerun_process(*arguments: str | Path) -> Iterator[tuple[subprocess.Popen[bytes], IO[bytes]]]:
    """Run the ``rerun`` executable until the block ends; yield the process and a file with the process's output."""
    with tempfile.TemporaryFile() as output:
        command = [rerun_program(), *map(str, arguments), *([] if "--bind" in arguments else ["--bind", LOCAL])]
        # The viewer's messages about software rendering would cover the screenshot.
        quiet = {"RUST_LOG": "error"} if "--headless" in command else {}
        process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT, env=quiet | dict(os.environ))
        try:
            yield process, output
        finally:
            process.terminate()
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def viewer_error(output: IO[bytes]) -> RuntimeError:
    """Return an error that explains, from the viewer's output, why the viewer ended."""
    output.seek(0)
    text = re.sub(r"\x1b\[[0-9;]*m", "", output.read().decode("utf-8", "replace"))  # remove color codes
    for pattern, reason in REASONS.items():
        if re.search(pattern, text):
            return RuntimeError(f"the Rerun viewer stopped: {reason}.")
    # Omit the stack trace and info messages.
    lines = [line for line in text.splitlines() if line.strip() and not re.match(r"\s+(\d+:|at )|.* INFO ", line)]
    return RuntimeError("the Rerun viewer ended with an error:\n" + "\n".join(lines[-12:]))
