"""The commands ``lw-torchrl record`` and ``view``: record episodes of a policy and view them in Rerun."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import OmitArgPrefixes, Positional, arg

import lw_torchrl as lw
from lw_torchrl._util.checks import Natural
from lw_torchrl.cli import options
from lw_torchrl.cli.evaluate import Rollout
from lw_torchrl.cli.options import Flag, Maybe, Output


@dataclass(kw_only=True)
class Record:
    """Record episodes: the robot in 3-D, the active plan step, the conditions that held, and the outcome.

    Example: lw-torchrl record drawer-open --policy runs/mt10.safetensors --compare scripted --episodes 0 1
    """

    tasks: options.TaskNames
    policy: options.Who = "expert"
    compare: Maybe[str] = None  # second policy to show side by side, with the same initial states and noise
    episodes: tuple[Natural, ...] = (0,)  # indices of the episodes, as in an evaluation with the same seed
    out: Maybe[Path] = None  # .rrd file to write (default: runs/recordings/TASK-POLICY.rrd)
    json: options.Json = False
    rollout: OmitArgPrefixes[Rollout] = field(default_factory=Rollout)

    def run(self) -> Output:
        from lw_torchrl.record.rollouts import new_recording, run_recorded

        rollout = self.rollout
        tasks, arguments = rollout.choose(self.tasks), rollout.arguments
        label = tasks[0].replace("/", "-") if len(tasks) == 1 else f"{len(tasks)}-tasks"
        out = self.out or Path("runs/recordings") / f"{label}-{options.policy_name(self.policy)}.rrd"
        reference = rollout.trusted_plans
        policies = [(name, *rollout.policy(name, tasks)) for name in (self.policy, self.compare) if name is not None]
        rows: list[dict[str, Any]] = []
        pages: list[list[str]] = []  # the names of each policy's episodes
        with new_recording(out) as logger:
            for number, (name, policy, plans, evaluator) in enumerate(policies, 1):
                run: dict[str, Any] = {"plans": plans, "episodes": self.episodes, "evaluator": evaluator, **arguments}
                run["stop_at_success"] = rollout.stop_at_success
                episodes = run_recorded(policy, tasks, progress=True, **run)
                failures: dict[tuple[str, int], Any] = {}
                if rollout.attribute and plans is not None and lw.modules.plans_of(policy) is not None:
                    rerun: dict[str, Any] = {"actor": policy, "reference": reference, "evaluator": evaluator}
                    attributed = lw.attribute_failures(episodes, plans, **rerun, **arguments)
                    failures = {(failure.task, failure.episode): failure for failure in attributed}
                pages.append([])
                for episode in episodes:
                    failure = failures.get((episode.task, episode.episode))
                    rows.append(_report(episode, options.policy_name(name), failure))
                    page: dict[str, Any] = {"seed": rollout.seed, "policy": rows[-1]["policy"], "failure": failure}
                    page["name"] = f"{episode.task}-{episode.episode}-{number}" if self.compare else None
                    suite = rollout.chosen_suite
                    pages[-1].append(lw.log_rollout(logger, episode.steps, plans, suite=suite, **page))
            for pair, episode in zip(zip(*pages, strict=True), episodes, strict=True) if self.compare else ():
                logger.compare(pair, f"{episode.task} · episode {episode.episode} · side by side")
        output = Output(self.json).show("episodes", rows)
        return output.show("recording", out, f"written to {out}\nopen it with: lw-torchrl view {out}")


def _report(episode: Any, policy: str, failure: Any) -> dict[str, Any]:
    """Print how an episode ended, and return the row of the JSON document that describes the episode."""
    first = episode.first_success
    ended = "failed" if first is None else f"success at step {first}"
    ended += "" if failure is None else f", {failure.cause}: {failure.why}"
    print(f"{episode.task}, episode {episode.episode}, {policy}: {ended}")
    row = {"task": episode.task, "episode": episode.episode, "policy": policy, "first_success": first}
    return row | {"failure": failure and failure.to_json()}


@dataclass(kw_only=True)
class View:
    """Open recordings in the Rerun viewer, in a window or a browser, or save a screenshot of the viewer.

    Several recordings are opened together in one viewer.

    Example: lw-torchrl view runs/demo --episode drawer-open --screenshot picture.png --step 80

    Example: lw-torchrl view runs/small/logs/policy.rrd runs/large/logs/policy.rrd
    """

    recordings: Positional[Annotated[tuple[Path, ...], options.REQUIRED, arg(metavar="FILES")]]
    """.rrd files, or folders of .rrd files"""
    episode: Maybe[str] = None  # title of the tab to open
    step: Maybe[Natural] = None  # time step to open at (default: an episode's success or failure, or the last step)
    screenshot: Maybe[Path] = None  # .png file to write without a window; requires Vulkan (mesa-vulkan-drivers)
    window_size: str = "1400x900"  # width x height of the window or screenshot, in pixels
    web: Flag = False  # serve Rerun's web viewer on this machine until Ctrl-C, and print the address
    port: Natural = 0  # with --web, port of the web viewer (0 picks a free port)

    def run(self) -> None:
        from lw_torchrl.record import open_viewer

        web_port = self.port if self.web else None
        tab: dict[str, Any] = {"episode": self.episode, "step": self.step}
        open_viewer(self.recordings, self.screenshot, self.window_size, web_port=web_port, **tab)
        if self.screenshot is not None:
            print(f"written to {self.screenshot}")
