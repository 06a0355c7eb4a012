"""Pictures of a dataset's rows: its episodes are run again, action by action, and drawn; a file of PNGs an episode.

root/pictures/<cameras>-<height>x<width>-every<k>/<task>.<episode>.zip    "0.png", "1.png", ...: of steps 0, k, 2k, ...
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv, step_mdp

from lw_torchrl._checks import check_int, checked
from lw_torchrl._files import AnyPath, replacing
from lw_torchrl._progress import Progress
from lw_torchrl._rendering import check_cameras
from lw_torchrl.data.dataset import DatasetError, Demonstrations, EpisodeInfo, read_metadata
from lw_torchrl.data.memory_map import load_rows, verify
from lw_torchrl.data.replay import LanguageWorldExperienceReplay
from lw_torchrl.envs.language_world_env import LanguageWorldEnv
from lw_torchrl.transforms.camera import CameraTransform

_TOGETHER = 8  # episodes run again at once
_LARGEST = 64 * 2**20  # bytes of a file of pictures


@dataclass(frozen=True)
class Pictures:
    cameras: tuple[str, ...]
    height: int
    width: int
    every: int

    @classmethod
    def of(cls, cameras: str | Sequence[str], height: int, width: int, every: int) -> Pictures:
        return cls(check_cameras(cameras, height, width), height, width, check_int("every", every, minimum=1))

    @property
    def shape(self) -> tuple[int, int, int]:
        return self.height, self.width * len(self.cameras), 3

    def file(self, root: Path, episode: EpisodeInfo) -> Path:
        folder = f"{'+'.join(self.cameras)}-{self.height}x{self.width}-every{self.every}"
        return root / "pictures" / folder / f"{episode.task}.{episode.episode}.zip"

    def count(self, episode: EpisodeInfo) -> int:
        return -(-episode.length // self.every)

    def read(self, root: Path, episode: EpisodeInfo) -> Tensor:
        """Those of an episode, (n, height, width·C, 3) uint8; DatasetError if its file is missing or damaged."""
        from PIL import Image

        path, count = self.file(root, episode), self.count(episode)
        try:
            if path.stat().st_size > _LARGEST:
                raise ValueError("it is larger than an episode's pictures can be")
            with zipfile.ZipFile(path) as archive:
                names = [f"{number}.png" for number in range(count)]
                if archive.namelist() != names or any(one.compress_type for one in archive.infolist()):
                    raise ValueError(f"it must hold {count} pictures, stored")
                pictures = np.empty((count, *self.shape), dtype=np.uint8)
                for number, name in enumerate(names):
                    with Image.open(io.BytesIO(archive.read(name)), formats=["PNG"]) as picture:
                        if picture.mode != "RGB" or picture.size != (self.shape[1], self.shape[0]):
                            raise ValueError(f"{name} is {picture.mode} of {picture.size} pixels")
                        pictures[number] = np.asarray(picture)
        except Exception as error:  # a damaged file may raise anything
            raise DatasetError(f"root: {str(path)!r} is damaged ({error}); add_pictures makes it anew") from error
        return torch.from_numpy(pictures)

    def missing(self, root: Path, episode: EpisodeInfo) -> bool:
        """Whether an episode's file is missing, or damaged and so to be written anew."""
        with suppress(DatasetError):
            self.read(root, episode)
            return False
        return True


@checked
def add_pictures(
    root: AnyPath,
    cameras: str | Sequence[str] = "corner",
    *,
    height: int = 64,
    width: int = 64,
    every: int = 1,
    progress: bool = True,
) -> None:
    """Draw the rows of a dataset, as :class:`CameraTransform` would have while it was collected.

    Each episode is run again with its actions, and must give the stored observations bit for bit. The pictures are
    saved beside the rows as PNGs. A call that was killed carries on when it is repeated.

    Args:
        root: the dataset's folder, of :func:`collect_demonstrations`.
        cameras, height, width, every: as for :class:`CameraTransform`.
        progress: show a progress bar when it takes longer than a second.

    Raises:
        DatasetError: (a ValueError) there is no dataset, or MuJoCo or Meta-World lets its episodes go otherwise today.
        ImportError: there is no OpenGL; it names what to install.
        OSError: there is no room; nothing is lost.

    Example:
        >>> import tempfile, lw_torchrl as lw
        >>> with tempfile.TemporaryDirectory() as root:
        ...     _ = lw.collect_demonstrations("reach", episodes_per_task=1, root=root + "/demos", max_steps=20)
        ...     lw.data.add_pictures(root + "/demos", "corner", every=10)
        ...     replay = lw.LanguageWorldExperienceReplay(root + "/demos", batch_size=8)
        ...     replay.add_column("pixels", lw.data.load_pictures(replay, "corner", every=10))
        ...     replay.sample()["pixels"].shape
        torch.Size([8, 64, 64, 3])
    """
    wanted, found = Pictures.of(cameras, height, width, every), read_metadata(Path(root))
    verify(found, found.episodes)
    rows = load_rows(found)
    missing = [one for one in found.episodes if wanted.missing(found.root, one)]
    with Progress("taking pictures", sum(map(wanted.count, missing)), "picture", show=progress) as bar:
        for task in found.config.tasks:
            own = [one for one in missing if one.task == task]
            for some in (own[first : first + _TOGETHER] for first in range(0, len(own), _TOGETHER)):
                for episode, taken in zip(some, _taken(found, rows, some, wanted), strict=True):
                    _write(wanted.file(found.root, episode), taken)
                    bar.update(len(taken))


def _taken(
    found: Demonstrations, rows: TensorDictBase, episodes: Sequence[EpisodeInfo], wanted: Pictures
) -> list[list[np.ndarray[Any, Any]]]:
    task, seed, steps = episodes[0].task, found.config.seed, found.config.max_steps
    base = LanguageWorldEnv(task, num_envs=len(episodes), seed=seed, max_steps=steps)
    camera = CameraTransform(wanted.cameras, height=wanted.height, width=wanted.width, every=wanted.every)
    taken: list[list[np.ndarray[Any, Any]]] = [[] for _ in episodes]
    starts = torch.tensor([one.start for one in episodes])
    lengths = torch.tensor([one.length for one in episodes])
    with closing(TransformedEnv(base, camera)) as env:
        state = env.reset(episode=torch.tensor([one.episode for one in episodes]))
        for step in range(int(lengths.max())):
            going = step < lengths
            here = rows[starts + torch.minimum(torch.tensor(step), lengths - 1)]
            if not torch.equal(state.get("observation")[going], here.get("observation")[going]):
                versions = ", ".join(f"{name} {version}" for name, version in found.versions.items())
                raise DatasetError(
                    f"root: episodes of {episodes[0].task!r} in {str(found.root)!r} go otherwise when they are run "
                    f"again, from step {step} on: they were made by {versions}"
                )
            if step % wanted.every == 0:
                for place in going.nonzero().flatten().tolist():
                    taken[place].append(state.get("pixels")[place].numpy())
            state.set("action", here.get("action")).set("_step", going)
            state = step_mdp(env.step(state), exclude_action=True).exclude("_step")
    return taken


def _write(path: Path, pictures: Sequence[np.ndarray[Any, Any]]) -> None:
    from PIL import Image

    with replacing(path, sync=False) as file, zipfile.ZipFile(file, "w") as archive:
        for number, picture in enumerate(pictures):
            stream = io.BytesIO()
            Image.fromarray(picture).save(stream, "PNG")
            archive.writestr(zipfile.ZipInfo(f"{number}.png"), stream.getvalue())  # of no date


@checked
def load_pictures(
    replay: LanguageWorldExperienceReplay,
    cameras: str | Sequence[str] = "corner",
    *,
    height: int = 64,
    width: int = 64,
    every: int = 1,
) -> Tensor:
    """The pictures of a buffer's rows, in memory, for ``replay.add_column("pixels", ...)``: (R, height, width·C, 3)
    uint8. They are those of ``observation``, in the order of ``replay[:]``; between two of an episode, the earlier one.

    ``cameras``, ``height``, ``width`` and ``every`` are as given to :func:`add_pictures`. Without such pictures, or if
    they are damaged, a :class:`DatasetError`, which is a ValueError, is raised.
    """
    wanted = Pictures.of(cameras, height, width, every)
    _, lengths = torch.unique_consecutive(replay.storage.column(("collector", "traj_ids")), return_counts=True)
    listed = [(part.root, episode) for part in replay.parts for episode in part.episodes]
    found = torch.empty((int(lengths.sum()), *wanted.shape), dtype=torch.uint8)
    row = 0
    for (root, episode), length in zip(listed, lengths.tolist(), strict=True):
        if not wanted.file(root, episode).is_file():
            by = f"by {', '.join(wanted.cameras)}, {height} times {width} pixels, every {every}"
            what = f"root: {str(root)!r} has no pictures of {episode.task}, episode {episode.episode}, {by}"
            raise DatasetError(f"{what}; lw.data.add_pictures({str(root)!r}, ...) takes them")
        found[row : row + length] = wanted.read(root, episode)[torch.arange(length) // every]
        row += length
    return found
