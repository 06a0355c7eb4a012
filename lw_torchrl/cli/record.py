"""``lw-torchrl record`` and ``view``: record episodes of a policy and look at them in rerun."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import OmitArgPrefixes, Positional, arg

import lw_torchrl as lw
from lw_torchrl.cli import options
from lw_torchrl.cli.acting import Acting, policy_name
from lw_torchrl.cli.options import Output


@dataclass(kw_only=True)
class Record:
    """Record episodes: the robot in 3-D, the plan step by step, which conditions held, and how it ended.

    Example: lw-torchrl record drawer-open --policy runs/mt10.safetensors --compare scripted --episodes 0 1
    """

    tasks: options.TaskNames
    policy: options.Who = "expert"
    compare: str | None = None  # a second policy, in the same initial states and with the same noise, side by side
    episodes: tuple[int, ...] = (0,)  # indices of the episodes, as in an evaluation with the same seed
    out: Path | None = None  # .rrd file to write; None for runs/recordings/TASK-POLICY.rrd
    json: options.Json = False
    acting: OmitArgPrefixes[Acting] = field(default_factory=Acting)

    def run(self) -> Output:
        from lw_torchrl.record.rollouts import new_recording, run_recorded

        tasks, run = self.acting.choose(self.tasks), self.acting.run
        label = tasks[0].replace("/", "-") if len(tasks) == 1 else f"{len(tasks)}-tasks"
        out = self.out or Path("runs/recordings") / f"{label}-{policy_name(self.policy)}.rrd"
        reference = self.acting.trusted_plans
        cast = [(who, *self.acting.policy(who, tasks)) for who in (self.policy, self.compare) if who is not None]
        rows: list[dict[str, Any]] = []
        recorded: list[list[str]] = []
        with new_recording(out) as logger:
            for who, policy, shown, evaluator in cast:
                asked: dict[str, Any] = {"plans": shown, "episodes": self.episodes, "evaluator": evaluator, **run}
                stop = self.acting.stop_at_success
                episodes = run_recorded(policy, tasks, stop_at_success=stop, progress=True, **asked)
                failures: dict[tuple[str, int], Any] = {}
                if self.acting.attribute and shown is not None and lw.modules.plans_of(policy) is not None:
                    again: dict[str, Any] = {"actor": policy, "reference": reference, "evaluator": evaluator, **run}
                    attributed = lw.attribute_failures(episodes, shown, **again)
                    failures = {(failure.task, failure.episode): failure for failure in attributed}
                    if failures and not recorded:
                        logger.show_causes(self._result(episodes, attributed))
                pages = []
                for episode in episodes:
                    failure, first = failures.get((episode.task, episode.episode)), episode.first_success
                    ended = "failed" if first is None else f"success at step {first}"
                    ended += "" if failure is None else f", {failure.cause}: {failure.why}"
                    print(f"{episode.task}, episode {episode.episode}, {policy_name(who)}: {ended}")
                    row = {"task": episode.task, "episode": episode.episode, "policy": policy_name(who)}
                    rows.append(row | {"first_success": first, "failure": failure and failure.to_json()})
                    page: dict[str, Any] = {"seed": self.acting.seed, "policy": policy_name(who), "failure": failure}
                    name = f"{episode.task}-{episode.episode}-{len(recorded) + 1}" if self.compare else None
                    suite = self.acting.in_suite
                    pages.append(lw.log_rollout(logger, episode.steps, shown, suite=suite, name=name, **page))
                recorded.append(pages)
            for pair, episode in zip(zip(*recorded, strict=True), episodes, strict=True) if self.compare else ():
                logger.compare(pair, f"{episode.task} · episode {episode.episode} · side by side")
        output = Output(self.json).show("episodes", rows)
        return output.show("recording", out, f"written to {out}\nopen it with: lw-torchrl view {out}")

    def _result(self, episodes: Any, failures: Any) -> lw.EvaluationResult:
        """Return the recorded episodes and their failures as an evaluation's result."""
        ended = [(one.task, one.episode, one.first_success is not None, one.first_success) for one in episodes]
        config = {
            "tasks": list(dict.fromkeys(one.task for one in episodes)),
            "episodes_per_task": len(self.episodes),
            "seed": self.acting.seed,
            "max_steps": max(len(one.steps) for one in episodes),
        }
        listed = tuple(lw.evaluation.EpisodeResult(*one, None, None) for one in ended)
        return lw.EvaluationResult(config, listed, failures=tuple(failures))


@dataclass(kw_only=True)
class View:
    """Open recordings in the rerun viewer, or write a picture or a web page of one.

    Several recordings are opened together in one viewer.

    Example: lw-torchrl view runs/demo --episode drawer-open --screenshot picture.png --step 80

    Example: lw-torchrl view runs/small/logs/policy.rrd runs/large/logs/policy.rrd
    """

    recordings: Positional[Annotated[tuple[Path, ...], options.REQUIRED, arg(metavar="FILES")]]
    """.rrd files, or folders with one"""
    episode: str | None = None  # title of the tab to open
    step: int | None = None  # step to open at; None for the one that decides the episode, or the last of a training
    screenshot: Path | None = None  # write a .png without a window; requires a Vulkan driver (mesa-vulkan-drivers)
    window_size: str = "1400x900"  # width x height of the window or picture, in pixels
    html: Path | None = None  # write one self-contained HTML page (about 11 MB)
    web: bool = False  # serve a page on this machine and print its address, until Ctrl-C
    port: int = 0  # with --web, port of the page (0 picks a free one)

    def run(self) -> None:
        from lw_torchrl.record import WebPage, open_viewer, write_html

        if sum((self.screenshot is not None, self.html is not None, self.web)) > 1:
            raise ValueError("choose one of --screenshot, --html and --web")
        if (self.web or self.html is not None) and len(self.recordings) > 1:
            raise ValueError(f"--web and --html show one recording, got {len(self.recordings)}")
        tab: dict[str, Any] = {"episode": self.episode, "step": self.step}
        if self.web:
            with WebPage(self.recordings[0], port=self.port, **tab) as page:
                print(f"{page.address}  (Ctrl-C ends it)", flush=True)
                with suppress(KeyboardInterrupt):
                    page.serve()
        elif self.html is not None:
            write_html(self.recordings[0], self.html, **tab)
        else:
            open_viewer(self.recordings, self.screenshot, self.window_size, **tab)
        if written := self.html or self.screenshot:
            print(f"written to {written}")
