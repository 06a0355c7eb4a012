"""Rollouts to record, and recordings read back."""

import io
import socket
import uuid
from contextlib import contextmanager
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from rerun.chunk import RrdReader
from tensordict import TensorDict
from torchrl.envs import TransformedEnv

import lw_torchrl as lw
from lw_torchrl.language.queries import parse_query
from lw_torchrl.record import RerunLogger
from lw_torchrl.record.recorded_episode import GRIPPER
from lw_torchrl.record.tabs import Tabs

STEPS = (
    ("the robot's gripper is not near the puck", "place the gripper above the puck"),
    ("the robot's gripper is near the puck", "close the gripper around the puck"),
)
PLAN = SimpleNamespace(steps=[SimpleNamespace(condition=parse_query(c, "push"), skill=s) for c, s in STEPS])


def make_rollout(length=20, columns=3, seed=0):
    """Return random numbers in a rollout's shapes; the columns beyond the plan's two steps are padding."""
    draw = partial(torch.rand, generator=torch.Generator().manual_seed(seed))
    qaf = draw(length, columns) > 0.5
    qaf[:, len(STEPS) :] = False
    skill_weights = torch.zeros(length, columns)
    skill_weights[:, : len(STEPS)] = torch.softmax(qaf[:, : len(STEPS)] * 10.0 - 5.0, -1)
    rollout = {"observation": draw(length, 39), "action": draw(length, 4) * 2 - 1, "qaf": qaf}
    after = {"success": torch.arange(length)[:, None] >= length // 2, "reward": draw(length, 1)}
    return TensorDict({**rollout, "skill_weights": skill_weights, "next": after}, [length])


def run(tasks, length, *, seed=5, plans=None, skills=None):
    """Return a rollout (tasks, T) of scripted skills, or without plans of experts."""
    base = lw.LanguageWorldEnv(tasks, seed=seed, num_threads=1, max_steps=length)
    if plans is None:
        env, actor = base, lw.ExpertActor(tasks)
    else:
        env, actor = TransformedEnv(base, lw.QAFTransform(plans)), lw.ScriptedSkillActor(plans, skills=skills)
    with torch.no_grad():
        rollout = env.rollout(length, actor)
    env.close()
    return rollout


def make_objects(rollout):
    observation = rollout["observation"]
    return {GRIPPER: observation[:, :3], "puck": observation[:, 4:7]}


def record(path, *rollouts, **kwargs):
    with RerunLogger(path) as logger:
        for rollout in rollouts:
            logger.log_episode(rollout, **{"task": "push", "objects": make_objects(rollout), "plan": PLAN} | kwargs)
    return Recording(path)


class Recording:
    """A recording's columns, by entity and component."""

    def __init__(self, path):
        self.reader = RrdReader(path)
        self.columns = {}
        for chunk in self.reader.stream():
            batch = chunk.to_record_batch()
            times = {name: batch.column(name).to_numpy(zero_copy_only=False) for name in chunk.timeline_names}
            for name in batch.schema.names:
                if ":" in name:
                    entry = (times, batch.column(name).to_pylist())
                    self.columns.setdefault((chunk.entity_path, name), []).append(entry)

    def entities(self):
        return {entity for entity, _ in self.columns}

    def values(self, entity, component):
        """Return a list of instances for each time."""
        return [row for _, rows in self.columns[entity, component] for row in rows]

    def array(self, entity, component):
        return np.array(self.values(entity, component))

    def times(self, entity, component, timeline="step"):
        return np.concatenate([times[timeline] for times, _ in self.columns[entity, component]]).tolist()

    def is_static(self, entity, component):
        times, _ = self.columns[entity, component][0]
        return "step" not in times

    def images(self, entity):
        blobs = [bytes(blob[0]) for blob in self.values(entity, "EncodedImage:blob")]
        return [np.asarray(Image.open(io.BytesIO(blob))) for blob in blobs]

    def text(self, entity):
        return self.values(entity, "TextDocument:text")[0][0]

    def at(self, entity, component, step):
        """Return the instances that the viewer shows at a step: the static ones, or the latest."""
        rows = self.values(entity, component)
        if self.is_static(entity, component):
            return rows[-1]
        return rows[np.searchsorted(self.times(entity, component), step, side="right") - 1]

    def in_frame(self, entity, frame, part, step):
        """Return a part of the pose of one of an entity's frames at a step."""
        steps, frames = (self.times(entity, "Transform3D:child_frame"), self.values(entity, "Transform3D:child_frame"))
        rows = [i for i, (at, of) in enumerate(zip(steps, frames, strict=True)) if of == [frame] and at <= step]
        return self.values(entity, f"Transform3D:{part}")[max(rows, key=lambda row: steps[row])][0]

    def states(self, entity, length, first=0):
        """Return the state at each of ``length`` steps, unrolled from its changes."""
        steps = self.times(entity, "StateChange:state")
        states = [row[0] for row in self.values(entity, "StateChange:state")]
        assert (steps[-1], states[-1]) == (first + length, "")
        at = np.searchsorted(steps, np.arange(length) + first, side="right") - 1
        return [states[i] for i in at]

    def saved_tabs(self):
        """Return the names of the tabs that the recording lists."""
        return [tab.name for tab in Tabs.read(self.reader).tabs()]

    def shown_tabs(self):
        """Return the titles in rerun's own layout, and the titles of each tab's views."""
        values = self.blueprint()
        (root,) = values["viewport", "root_container"]
        contents = values.get((f"container/{uuid.UUID(bytes=bytes(root))}", "contents"), [])
        title = lambda path: values.get((path.strip("/"), "display_name"), [""])[0]  # noqa: E731
        inside = lambda path: values.get((path.strip("/"), "contents"), [])  # noqa: E731
        return {title(path): [title(child) for child in inside(path)] for path in contents}

    def blueprint(self):
        """Return the values of rerun's layout, by entity and field."""
        values = {}
        for chunk in self.reader.stream(store=self.reader.blueprints()[-1]):
            rows = chunk.to_record_batch()
            for name in rows.schema.names:
                for value in rows.column(name).to_pylist() if ":" in name else ():
                    if value:
                        values[chunk.entity_path.strip("/"), name.partition(":")[2]] = value
        return values


@contextmanager
def skip_without_graphics_driver():
    try:
        yield
    except RuntimeError as error:
        if "no graphics driver" in str(error):
            pytest.skip("no graphics driver")
        raise


def listens(port):
    """Return whether a server on this machine accepts connections."""
    with socket.socket() as client:
        return not client.connect_ex(("127.0.0.1", port))
