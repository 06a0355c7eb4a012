"""``lw-torchrl data``: what datasets hold, and whether they are as they were written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import median, quantiles
from textwrap import fill
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from lw_torchrl._checks import counted

if TYPE_CHECKING:
    from lw_torchrl.data.behaviours import Behaviour
    from lw_torchrl.data.dataset import Demonstrations, EpisodeInfo


@dataclass(frozen=True)
class _Episode:
    """What is told of an episode: who acted, how it is described, its dense return."""

    behaviour: str
    info: EpisodeInfo
    earned: float


_HEADINGS = f"{'episodes':>8} {'steps':>9} {'success':>7} {'first success':>15} {'dense return':>12} {'quartiles':>24}"
_WIDTH = 120


def data(
    action: Positional[Annotated[Literal["show"], arg(metavar="show")]],
    folders: Positional[Annotated[tuple[Path, ...], arg(metavar="FOLDERS ...")]],
    /,
    check: bool = False,
) -> None:
    """Show what datasets hold: who acted, in what, how often it succeeded, what it earned. Several are a mixture.

    Example: lw-torchrl data show demos/mt10 demos/spoilt --check

    Args:
        action: the word show.
        folders: of `lw-torchrl collect`.
        check: also read them through against their checksums.
    """
    from lw_torchrl.data.metadata import read_metadata
    from lw_torchrl.data.replay_checks import check_behaviours

    if not folders:
        raise ValueError("folders must name at least one dataset")
    parts = [read_metadata(folder) for folder in folders]
    check_behaviours(parts)
    told: list[_Episode] = []
    for part in parts:
        own = _episodes(part)
        print("\n".join(_about(part)) + "\n")
        told += own
    _table("task", _by(told, lambda one: one.info.task))
    if len(parts) > 1:
        print()
        _table("behaviour", _by(told, lambda one: one.behaviour))
    print(_row("all", told))
    if check:
        _check(parts)


def _by(told: list[_Episode], key: Callable[[_Episode], str]) -> dict[str, list[_Episode]]:
    found: dict[str, list[_Episode]] = {}
    for one in told:
        found.setdefault(key(one), []).append(one)
    return dict(sorted(found.items()))


def _episodes(part: Demonstrations) -> list[_Episode]:
    from lw_torchrl.data.selection import returns_of

    earned = returns_of(part, part, "dense", None)[:, 0].tolist()
    return [_Episode(part.config.behaviour, *pair) for pair in zip(part.episodes, earned, strict=True)]


def _about(part: Demonstrations) -> list[str]:
    """What a dataset's metadata say of it, in lines."""
    from lw_torchrl.data.metadata import FORMAT_VERSION

    how = part.config
    size = sum(path.stat().st_size for path in part.root.rglob("*") if path.is_file())
    noise = "none"
    if any(how.noise_scale):
        scales = ", ".join(f"{scale:g}" for scale in how.noise_scale)
        noise = f"{scales}; held for {counted(how.noise_hold, 'step')}, on the gripper x{how.gripper_noise_factor:g}"
    asked = f"{how.episodes_per_task} of each task, of at most {counted(how.max_steps, 'step')}, seed {how.seed}"
    redrawn = sum(part.attempts.values()) - len(part.episodes)
    lines = {
        "dataset": f"{part.root}: {_bytes(size)}, format version {FORMAT_VERSION}",
        "behaviour": f"{how.behaviour}: {_acted(how.policy)}",
        "tasks": ", ".join(how.tasks) if len(how.tasks) <= 10 else counted(len(how.tasks), "task"),
        "episodes": asked + (f"; {counted(redrawn, 'failure')} drawn again" if how.redraw_failures else ""),
        "noise": noise,
        "made with": ", ".join(f"{name}\N{NO-BREAK SPACE}{version}" for name, version in part.versions.items()),
    }
    return [_wrapped(f"{name:10} {line}") for name, line in lines.items()]


def _wrapped(line: str) -> str:
    found = fill(line, _WIDTH, subsequent_indent=" " * 11, break_long_words=False, break_on_hyphens=False)
    return found.replace("\N{NO-BREAK SPACE}", " ")


def _acted(who: Behaviour) -> str:
    if who.kind == "expert":
        return "Meta-World's scripts"
    if who.kind == "policy":
        return f"a policy, fingerprint {who.fingerprint}"
    pieces = f"{who.shortest} to {who.longest} steps"
    other = {"skill": "any skill of the plan", "action": "one action"}[who.otherwise]
    if who.right == 0.0:
        return f"{other} for {pieces}, after another"
    plans = f"plans (fingerprint {str(who.fingerprint)[:16]}) with scripted skills"
    return plans if who.right == 1.0 else f"{plans} in {who.right:.3g} of pieces of {pieces}, else {other}"


def _bytes(size: float) -> str:
    for unit in ("B", "kB", "MB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.3g} GB"


def _table(name: str, lines: dict[str, list[_Episode]]) -> None:
    print(f"{name:28} {_HEADINGS}")
    for label, episodes in lines.items():
        print(_row(label, episodes))


def _row(label: str, episodes: list[_Episode]) -> str:
    first = [one.info.first_success for one in episodes if one.info.first_success is not None]
    earned = [one.earned for one in episodes]
    low, middle, high = quantiles(earned, n=4, method="inclusive") if len(earned) > 1 else earned * 3
    when = f"{median(first):.0f} ({min(first)}..{max(first)})" if first else "never"
    return (
        f"{label if len(label) <= 28 else label[:25] + '...':28} {len(episodes):8} "
        f"{sum(one.info.length for one in episodes):9} {len(first) / len(episodes):7.2f} {when:>15} "
        f"{sum(earned) / len(earned):12.1f} {f'{low:.1f} {middle:.1f} {high:.1f}':>24}"
    )


def _check(parts: list[Demonstrations]) -> None:
    from lw_torchrl.data.rows import whole_episodes

    for part in parts:
        if broken := len(part.episodes) - len(whole_episodes(part, progress=True)):
            raise ValueError(
                f"{str(part.root)!r} is damaged: {broken} of {counted(len(part.episodes), 'episode')} differ from "
                "their checksums; the same collect_demonstrations runs these again"
            )
    print(f"\nchecked: all rows of {counted(len(parts), 'dataset')} are as they were written")
