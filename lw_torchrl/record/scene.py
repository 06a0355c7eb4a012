"""One episode as checked arrays, and the 3-D scene that is drawn from it.

Meta-World's frame: metres, x to the robot's right, y away from the robot, z up, the table's top at z = 0.
Static things are sent once; what moves is sent as whole columns, one call per entity.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase

if TYPE_CHECKING:
    from rerun import RecordingStream

Color = tuple[int, ...]

EPISODE_TIMELINE, SECONDS_TIMELINE = "step", "time"
GRIPPER = "robot's gripper"
CONTROL_PERIOD = 0.0125
"""Seconds between two actions in Meta-World: 5 simulation steps of 2.5 ms, hence 80 Hz."""

# Measured in Meta-World's model: obs[3] is the distance between the fingers over 0.1 m; they slide along y
# and reach 4.5 cm below obs[0:3], the position of the hand.
FINGER_TRAVEL = 0.1
FINGER_HALF = (0.010, 0.006, 0.024)
FINGER_DROP = 0.026
PALM_HALF = (0.018, 0.062, 0.014)
PALM_RISE = 0.012
WRIST_HALF = (0.012, 0.012, 0.055)
WRIST_RISE = 0.081
TABLE_CENTER, TABLE_HALF = (0.0, 0.6, -0.010), (0.7, 0.4, 0.010)

STEEL, GOLD, GREEN, TABLE, GRID = (205, 210, 220), (255, 200, 60), (90, 220, 120), (58, 64, 74), (92, 99, 112)
OBJECT_COLORS = ((80, 170, 255), (255, 120, 90), (200, 130, 255), (90, 220, 210))


class StepLike(Protocol):
    """A (condition, skill) pair: ``str(condition)`` is English, ``skill`` is a string."""

    @property
    def condition(self) -> object: ...
    @property
    def skill(self) -> str: ...


class PlanLike(Protocol):
    """Anything with ``steps``, such as :class:`lw_torchrl.ConditionalPlan`."""

    @property
    def steps(self) -> Sequence[StepLike]: ...


@dataclass(frozen=True)
class RecordedEpisode:
    """T rows of one episode, checked, on the CPU; S is the number of steps of its plan.

    Attributes:
        observation: T×39 float32; metres, gripper opening in [0,1] at index 3, goal at 36:39.
        action: T×4 float32, displacement xyz and gripper effort in [-1,1].
        objects: name -> T×3 float32 position in metres; the gripper is among them.
        qaf: T×S bool, truth of each condition, or None.
        skill_weights: T×S float32, attention over the steps, or None.
        success: T bool, of the state that the row's action led to, or None.
        reward: T float32, likewise, or None.
        steps: the S (condition, skill) texts; empty where there is no plan.
    """

    observation: NDArray[np.float32]
    action: NDArray[np.float32]
    objects: dict[str, NDArray[np.float32]]
    qaf: NDArray[np.bool_] | None
    skill_weights: NDArray[np.float32] | None
    success: NDArray[np.bool_] | None
    reward: NDArray[np.float32] | None
    steps: tuple[tuple[str, str], ...]

    @property
    def skills(self) -> list[str]:
        """A text for each column of skill_weights: "1 grasp the handle", or "1" where there is no plan."""
        count = 0 if self.skill_weights is None else self.skill_weights.shape[1]
        texts = [f" {skill}" for _, skill in self.steps] or [""] * count
        return [f"{i}{text}" for i, text in enumerate(texts, 1)]

    def __len__(self) -> int:
        return len(self.observation)

    @classmethod
    def from_rollout(
        cls, rollout: TensorDictBase, objects: Mapping[str, Any], plan: PlanLike | None = None
    ) -> RecordedEpisode:
        """Check a rollout; see :meth:`lw_torchrl.RerunLogger.log_episode` for the keys and the errors."""
        if not isinstance(rollout, TensorDictBase):
            raise TypeError(f"rollout must be a TensorDict, got {type(rollout).__name__}")
        if len(rollout.batch_size) != 1 or not rollout.batch_size[0]:
            hint = "; take one episode, rollout[i]" if len(rollout.batch_size) > 1 else ""
            raise ValueError(f"rollout must have batch size (T,) with T >= 1, got {tuple(rollout.batch_size)}{hint}")
        steps = tuple((str(step.condition), step.skill) for step in plan.steps) if plan is not None else ()
        length = rollout.batch_size[0]
        return cls(
            observation=_column(rollout, "observation", length, 39),
            action=_column(rollout, "action", length, 4),
            objects=_positions(objects, rollout, length),
            qaf=_truth(rollout, "qaf", length, len(steps)),
            skill_weights=_of_steps(rollout, "skill_weights", length, len(steps)),
            success=_flat(_truth(rollout, ("next", "success"), length, 1)),
            reward=_flat(_of_steps(rollout, ("next", "reward"), length, 1)),
            steps=steps,
        )


def _array(value: Any, label: str, shape: tuple[int | None, ...]) -> NDArray[Any]:
    """``value`` as an array of ``shape`` (None: any size) without NaN or infinity, or a ValueError."""
    tensor = torch.as_tensor(value).detach().cpu()
    allowed = "×".join("S" if size is None else str(size) for size in shape)
    if tensor.ndim != len(shape) or any(s not in (None, n) for s, n in zip(shape, tensor.shape, strict=True)):
        raise ValueError(f"{label} must have shape {allowed}, got {'×'.join(map(str, tensor.shape)) or 'a scalar'}")
    if tensor.dtype == torch.bool:
        return tensor.numpy()
    array = tensor.to(torch.float32).numpy()
    if not np.isfinite(array).all():
        row = int(np.argwhere(~np.isfinite(array))[0][0])
        raise ValueError(f"{label} must be finite, got {array[row].tolist()} in row {row}")
    return array


def _column(rollout: TensorDictBase, key: Any, length: int, size: int | None) -> NDArray[Any]:
    value = rollout.get(key, None)
    if value is None:
        found = ", ".join(sorted(map(str, rollout.keys())))
        raise ValueError(f"rollout must have the key {key!r} ({length}×{size}), got {found or 'no keys'}")
    return _array(value, f"rollout[{key!r}]", (length, size))


def _of_steps(rollout: TensorDictBase, key: Any, length: int, steps: int) -> NDArray[Any] | None:
    """An optional column with at least ``steps`` columns; those beyond are padding and dropped."""
    if rollout.get(key, None) is None:
        return None
    array = _column(rollout, key, length, None)
    if array.shape[1] < max(steps, 1):
        raise ValueError(f"rollout[{key!r}] must have a column for each of {steps} plan steps, got {array.shape[1]}")
    return array[:, :steps] if steps else array


def _truth(rollout: TensorDictBase, key: Any, length: int, steps: int) -> NDArray[np.bool_] | None:
    array = _of_steps(rollout, key, length, steps)
    if array is not None and array.dtype != np.bool_:
        raise ValueError(f"rollout[{key!r}] must be bool, got {rollout.get(key).dtype}")
    return array


def _flat(array: NDArray[Any] | None) -> NDArray[Any] | None:
    return None if array is None else array[:, 0]


def _positions(objects: Any, rollout: TensorDictBase, length: int) -> dict[str, NDArray[np.float32]]:
    if not isinstance(objects, Mapping):
        raise TypeError(f"objects must map names to T×3 positions, got {type(objects).__name__}")
    for name in objects:
        if not isinstance(name, str) or not name:
            raise TypeError(f"objects must be named by non-empty strings, got {name!r}")
    checked = {name: _array(value, f"objects[{name!r}]", (length, 3)) for name, value in objects.items()}
    if GRIPPER not in checked:
        checked[GRIPPER] = _column(rollout, "observation", length, 39)[:, :3]
    return checked


def entity_path(*parts: str) -> str:
    """An absolute entity path of parts that may hold any character."""
    import rerun as rr

    return "".join("/" + rr.escape_entity_path_part(part) for part in parts)


def time_columns(steps: NDArray[np.int64], period: float = CONTROL_PERIOD) -> list[Any]:
    """The two timelines of an episode: steps, and seconds at ``period`` each."""
    import rerun as rr

    nanoseconds = (steps * round(period * 1e9)).astype("timedelta64[ns]")
    return [
        rr.TimeColumn(EPISODE_TIMELINE, sequence=steps),
        rr.TimeColumn(SECONDS_TIMELINE, duration=nanoseconds),
    ]


def log_scene(stream: RecordingStream, root: str, episode: RecordedEpisode) -> list[str]:
    """Draw the table, the gripper, the objects, their paths and the goal under ``root``/scene.

    Returns:
        The entity paths of the trails: one short line per row, to be shown up to the time cursor.
    """
    import rerun as rr

    scene, times = f"{root}/scene", time_columns(np.arange(len(episode)))
    solid = rr.components.FillMode.Solid

    def box(path: str, centers: Any, half_sizes: Any, color: Color, labels: list[str] | None = None) -> None:
        boxes = rr.Boxes3D.from_fields(
            centers=centers,
            half_sizes=half_sizes,
            colors=[color] * len(half_sizes),
            fill_mode=solid,
            labels=labels,
            show_labels=labels is not None,
        )
        stream.log(f"{scene}/{path}", boxes, static=True)

    stream.log(scene, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    box("table", [TABLE_CENTER], [TABLE_HALF], TABLE)
    stream.log(f"{scene}/table/grid", rr.LineStrips3D(_grid(), colors=[GRID], radii=[0.0007]), static=True)
    box("gripper/palm", [(0.0, 0.0, PALM_RISE)], [PALM_HALF], STEEL)
    # Its name stands above the hand, where the objects that it handles are not.
    box("gripper/wrist", [(0.0, 0.0, WRIST_RISE)], [WRIST_HALF], STEEL, [GRIPPER])
    box("gripper/fingers", None, [FINGER_HALF] * 2, GOLD)
    stream.send_columns(f"{scene}/gripper", times, rr.Transform3D.columns(translation=episode.objects[GRIPPER]))
    fingers = rr.Boxes3D.columns(centers=_finger_centers(episode.observation[:, 3]))
    stream.send_columns(f"{scene}/gripper/fingers", times, fingers.partition([2] * len(episode)))

    def point(path: str, position: NDArray[np.float32], label: str | None, radius: float, color: Color) -> None:
        labels = None if label is None else [label]
        style = rr.Points3D.from_fields(radii=[radius], colors=[color], labels=labels, show_labels=label is not None)
        stream.log(f"{scene}/{path}", style, static=True)
        stream.send_columns(f"{scene}/{path}", times, rr.Points3D.columns(positions=position))

    def lines(path: str, strips: NDArray[np.float32], radius: float, color: Color) -> None:
        style = rr.LineStrips3D.from_fields(colors=[color], radii=[radius])
        stream.log(f"{scene}/{path}", style, static=True)
        stream.send_columns(f"{scene}/{path}", times, rr.LineStrips3D.columns(strips=strips))

    goal = np.ascontiguousarray(episode.observation[:, 36:39])
    # Objects that stand for the goal, like "target location", have its colour, and their own label.
    goals = [name for name, position in episode.objects.items() if np.allclose(goal, position, atol=1e-3)]
    trails = []
    for name, color in _colors(episode.objects, goals).items():
        part, position = entity_path(name), episode.objects[name]
        point(
            f"objects{part}",
            position,
            None if name == GRIPPER else name,
            0.005 if name == GRIPPER else 0.016,
            color,
        )
        lines(f"heights{part}", _to_table(position), 0.0012, (*color, 150))
        # The whole way, faint, and the way so far.
        whole = rr.LineStrips3D([position], colors=[(*color, 70)], radii=[0.0012])
        stream.log(f"{scene}/paths{part}", whole, static=True)
        trails.append(f"{scene}/trails{part}")
        lines(f"trails{part}", _from_row_before(position), 0.003, color)

    if goal.any():
        point("goal", goal, None, 0.022, (*GREEN, 120))
        lines("goal/height", _to_table(goal), 0.0012, GREEN)
        if not goals:
            point("goal/foot", _to_table(goal)[:, 1], "goal", 0.005, GREEN)
    return trails


def _grid(spacing: float = 0.1) -> list[list[tuple[float, float, float]]]:
    """Lines on the table, ``spacing`` metres apart."""
    (left, near), (right, far) = (
        tuple(c + sign * h for c, h in zip(TABLE_CENTER[:2], TABLE_HALF[:2], strict=True)) for sign in (-1, 1)
    )
    z = 0.0005
    across = [[(left, y, z), (right, y, z)] for y in np.arange(near, far + 1e-6, spacing).tolist()]
    along = [[(x, near, z), (x, far, z)] for x in np.arange(left, right + 1e-6, spacing).tolist()]
    return across + along


def _colors(objects: Mapping[str, Any], goals: Sequence[str]) -> dict[str, Color]:
    others = [name for name in objects if name != GRIPPER]
    palette: dict[str, Color] = {name: OBJECT_COLORS[i % len(OBJECT_COLORS)] for i, name in enumerate(others)}
    return {GRIPPER: GOLD} | palette | dict.fromkeys([name for name in goals if name != GRIPPER], GREEN)


def _finger_centers(opening: NDArray[np.float32]) -> NDArray[np.float32]:
    """2T×3 centres of the fingers of T rows, metres in the gripper's frame; ``opening`` T in [0,1]."""
    half = opening * FINGER_TRAVEL / 2 + FINGER_HALF[1]
    zero, drop = np.zeros_like(half), np.full_like(half, -FINGER_DROP)
    return np.stack([zero, half, drop, zero, -half, drop], axis=1).reshape(-1, 3).astype(np.float32)


def _from_row_before(position: NDArray[np.float32]) -> NDArray[np.float32]:
    """T×2×3 lines: from the row before (the first: from itself) to each row."""
    return np.stack([np.concatenate([position[:1], position[:-1]]), position], axis=1)


def _to_table(position: NDArray[np.float32]) -> NDArray[np.float32]:
    """T×2×3 lines: from each row straight down (or up) to the table's top."""
    return np.stack([position, position * np.array([1, 1, 0], np.float32)], axis=1)
