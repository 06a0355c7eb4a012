"""Pictures of a dataset's rows: re-run and render the episodes, and store a zip file of PNGs for each episode.

root/pictures/<cameras>-<height>x<width>-every<k>/<task>.<episode>.zip    "0.png", "1.png", ... of steps 0, k, 2k, ...
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv, step_mdp

from lw_torchrl._util.checks import Count, typed
from lw_torchrl._util.files import AnyPath, check_damage, replacing
from lw_torchrl._util.progress import Progress
from lw_torchrl._util.rendering import check_cameras
from lw_torchrl.data import dataset
from lw_torchrl.data.dataset import TRAJECTORY, DatasetError, Demonstrations, EpisodeInfo
from lw_torchrl.data.replay import LanguageWorldExperienceReplay
from lw_torchrl.envs.language_world_env import LanguageWorldEnv
from lw_torchrl.transforms.observations import CameraTransform

_TOGETHER = 8  # number of episodes that are re-run in parallel


@dataclass(frozen=True)
class Pictures:
    """The cameras, image size and interval of a set of pictures; these values determine the file names."""

    cameras: tuple[str, ...]
    height: int
    width: int
    every: int

    @property
    def shape(self) -> tuple[int, int, int]:
        return self.height, self.width * len(self.cameras), 3

    def file(self, root: Path, episode: EpisodeInfo) -> Path:
        folder = f"{'+'.join(self.cameras)}-{self.height}x{self.width}-every{self.every}"
        return root / "pictures" / folder / f"{episode.task}.{episode.episode}.zip"

    def count(self, episode: EpisodeInfo) -> int:
        return -(-episode.length // self.every)

    def read(self, root: Path, episode: EpisodeInfo) -> Tensor:
        """Read an episode's pictures (n, height, width·C, 3) uint8; raise DatasetError if the file is corrupted."""
        from PIL import Image

        path = self.file(root, episode)
        pictures = np.empty((self.count(episode), *self.shape), dtype=np.uint8)
        try:
            with zipfile.ZipFile(path) as archive:
                for number in range(len(pictures)):
                    with Image.open(archive.open(f"{number}.png"), formats=["PNG"]) as picture:
                        if picture.size != (pictures.shape[2], pictures.shape[1]):  # before it is decompressed
                            raise ValueError(f"picture {number} has {picture.size[0]} x {picture.size[1]} pixels")
                        pictures[number] = np.asarray(picture)
        except Exception as error:  # zipfile and PIL raise many kinds of errors for corrupted files
            check_damage(error)
            message = f"root: {str(path)!r} is corrupted ({error}); delete this file and call add_pictures"
            raise DatasetError(message) from error
        return torch.from_numpy(pictures)


@typed
def add_pictures(
    root: AnyPath,
    cameras: str | Sequence[str] = "corner",
    *,
    height: Count = 64,
    width: Count = 64,
    every: Count = 1,
    progress: bool = True,
) -> None:
    """Render pictures of a dataset's rows, as :class:`CameraTransform` would have done during collection.

    Each episode is re-run with the stored actions, and the observations must be bit-identical to the stored ones. The
    pictures are saved as PNGs in the dataset's folder. After an interruption, call the function again to resume.

    Args:
        root: the dataset's folder, written by :func:`collect_demonstrations`.
        cameras, height, width, every: see :class:`CameraTransform`.
        progress: show a progress bar if rendering takes longer than a second.

    Raises:
        DatasetError: (a ValueError) there is no dataset, or the installed simulator gives different observations.
        ImportError: OpenGL is not available; the message names the packages to install.

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
    pictures = Pictures(check_cameras(cameras, height, width), height, width, every)
    demonstrations = dataset.read_metadata(root)
    dataset.verify(demonstrations, demonstrations.episodes)
    rows = dataset.load_rows(demonstrations)
    missing = [each for each in demonstrations.episodes if not pictures.file(demonstrations.root, each).is_file()]
    with Progress("rendering", sum(map(pictures.count, missing)), "picture", show=progress) as bar:
        for task in demonstrations.config.tasks:
            episodes = [episode for episode in missing if episode.task == task]
            for start in range(0, len(episodes), _TOGETHER):
                group = episodes[start : start + _TOGETHER]
                for episode, images in zip(group, _render(demonstrations, rows, group, pictures), strict=True):
                    _write(pictures.file(demonstrations.root, episode), images)
                    bar.update(len(images))


def _render(
    demonstrations: Demonstrations, rows: TensorDictBase, episodes: Sequence[EpisodeInfo], pictures: Pictures
) -> list[list[np.ndarray[Any, Any]]]:
    """Re-run some episodes of one task in parallel, and return the camera images of each episode."""
    task, seed, steps = episodes[0].task, demonstrations.config.seed, demonstrations.config.max_steps
    base = LanguageWorldEnv(task, num_envs=len(episodes), seed=seed, max_steps=steps)
    camera = CameraTransform(pictures.cameras, height=pictures.height, width=pictures.width, every=pictures.every)
    images: list[list[np.ndarray[Any, Any]]] = [[] for _ in episodes]
    starts = torch.tensor([episode.start for episode in episodes])
    lengths = torch.tensor([episode.length for episode in episodes])
    with closing(TransformedEnv(base, camera)) as env:
        state = env.reset(episode=torch.tensor([episode.episode for episode in episodes]))
        for step in range(int(lengths.max())):
            active = step < lengths
            stored = rows[starts + torch.minimum(torch.tensor(step), lengths - 1)]
            if not torch.equal(state.get("observation")[active], stored.get("observation")[active]):
                versions = ", ".join(f"{name} {version}" for name, version in demonstrations.versions.items())
                problem = f"re-running {task!r} of {str(demonstrations.root)!r} gives other states from step {step} on"
                raise DatasetError(f"root: {problem}; install the versions with which it was collected: {versions}")
            if step % pictures.every == 0:
                for place in active.nonzero().flatten().tolist():
                    images[place].append(state.get("pixels")[place].numpy())
            state.set("action", stored.get("action")).set("_step", active)
            state = step_mdp(env.step(state), exclude_action=True).exclude("_step")
    return images


def _write(path: Path, pictures: Sequence[np.ndarray[Any, Any]]) -> None:
    from PIL import Image

    with replacing(path, sync=False) as file, zipfile.ZipFile(file, "w") as archive:
        for number, picture in enumerate(pictures):
            stream = io.BytesIO()
            Image.fromarray(picture).save(stream, "PNG")
            # Use a ZipInfo without the current date, so that equal pictures give equal files.
            archive.writestr(zipfile.ZipInfo(f"{number}.png"), stream.getvalue())


@typed
def load_pictures(
    replay: LanguageWorldExperienceReplay,
    cameras: str | Sequence[str] = "corner",
    *,
    height: Count = 64,
    width: Count = 64,
    every: Count = 1,
) -> Tensor:
    """Load the pictures (R, height, width·C, 3) uint8 of a buffer's rows, for ``replay.add_column("pixels", ...)``.

    Row i shows the ``observation`` of ``replay[i]``; rows between two pictures get the earlier picture. ``cameras``,
    ``height``, ``width`` and ``every`` must be the values passed to :func:`add_pictures`.

    Raises:
        DatasetError: (a ValueError) the pictures are missing or corrupted.
    """
    pictures = Pictures(check_cameras(cameras, height, width), height, width, every)
    _, lengths = torch.unique_consecutive(replay.storage[:].get(TRAJECTORY), return_counts=True)
    episodes = [(part.root, episode) for part in replay.parts for episode in part.episodes]
    images = torch.empty((int(lengths.sum()), *pictures.shape), dtype=torch.uint8)
    row = 0
    for (root, episode), length in zip(episodes, lengths.tolist(), strict=True):
        if not pictures.file(root, episode).is_file():
            missing = f"root: {str(root)!r} has no such pictures for episode {episode.episode} of {episode.task!r}"
            raise DatasetError(f"{missing}; render them with lw.data.add_pictures({str(root)!r}, ...)")
        images[row : row + length] = pictures.read(root, episode)[torch.arange(length) // every]
        row += length
    return images
