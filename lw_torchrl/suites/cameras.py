"""Render camera images of MuJoCo states and read body poses; one OpenGL context serves all models."""

from __future__ import annotations

import atexit
import os
import re
import sys
from collections.abc import Sequence
from typing import Any, ClassVar
from weakref import WeakSet

import mujoco
import numpy as np
from numpy.typing import NDArray

from lw_torchrl._util.rendering import RENDER_LIBRARIES
from lw_torchrl.suites.engine import BodyPoses, RowModel

_FINGER = re.compile("finger|claw|pad")
_ROLLED = ("corner", "corner2", "corner3", "corner4")  # Meta-World mounts these upside down
_MOST_GEOMS = 2000
# With shadows and reflections, a software renderer would be four times slower.
_SWITCHED_OFF = (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION)


def _open_gl() -> Any:
    """Open a windowless OpenGL context with the backend that MUJOCO_GL names; if unset and without a display, EGL."""
    # MuJoCo reads MUJOCO_GL when it is imported, but robosuite sets the variable after that import.
    headless = sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    backend = os.environ.get("MUJOCO_GL", "").lower().strip() or ("egl" if headless else "")
    if backend == "egl":
        before = os.environ.get("PYOPENGL_PLATFORM")
        from mujoco.egl import GLContext  # sets PYOPENGL_PLATFORM, which child processes would inherit

        if before is None:
            os.environ.pop("PYOPENGL_PLATFORM", None)
    else:
        from mujoco.gl_context import GLContext
    return GLContext(64, 64)


def _no_open_gl(error: Exception) -> ImportError:
    backend = os.environ.get("MUJOCO_GL", "").lower().strip()
    library = RENDER_LIBRARIES.get(backend or "egl", "OpenGL and a display")
    return ImportError(
        f"camera images need OpenGL, which failed to start with MUJOCO_GL={backend or '(unset)'}: install {library}, "
        f"or start Python with MUJOCO_GL=egl or MUJOCO_GL=osmesa. Simulations and recordings need no OpenGL. ({error})"
    )


_open: WeakSet[Cameras] = WeakSet()
_processes: set[int] = set()  # IDs of processes that opened OpenGL: this one, or those it was forked from


def _close_all() -> None:
    for cameras in list(_open):
        cameras.close()


class Cameras:
    """A renderer for one thread at a time. A model's meshes and textures are loaded at the model's first image."""

    def __init__(self) -> None:
        if _processes - {os.getpid()}:
            raise RuntimeError("OpenGL does not survive the fork of this process: use mp_start_method='spawn'")
        try:
            self._gl = _open_gl()
        except Exception as error:  # the type depends on the platform
            raise _no_open_gl(error) from error
        if not _open:
            atexit.unregister(_close_all)
            atexit.register(_close_all)  # registered last, so that _close_all runs before OpenGL's cleanup
        _open.add(self)
        _processes.add(os.getpid())
        self._loaded: dict[str, tuple[Any, Any]] = {}

    def picture(self, shown: RowModel, data: Any, *, camera: str, height: int, width: int) -> NDArray[np.uint8]:
        """Render a state and return the image (height, width, 3) uint8."""
        self._gl.make_current()
        try:
            return self._picture(shown, data, camera, height, width)
        finally:
            if type(self._gl).__module__ == "mujoco.egl":  # otherwise other threads could not use the context
                from OpenGL import EGL  # type: ignore[import-untyped]

                EGL.eglReleaseThread()

    def _picture(self, shown: RowModel, data: Any, camera: str, height: int, width: int) -> NDArray[np.uint8]:
        path, model = shown
        if path not in self._loaded:
            try:
                context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
            except mujoco.FatalError as error:
                raise _no_open_gl(error) from error
            self._loaded[path] = mujoco.MjvScene(model=model, maxgeom=_MOST_GEOMS), context
        view, context = self._loaded[path]
        if (context.offWidth, context.offHeight) != (width, height):
            mujoco.mjr_resizeOffscreen(width, height, context)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, context)
        place = mujoco.MjvCamera()
        place.type = mujoco.mjtCamera.mjCAMERA_FIXED
        place.fixedcamid = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, camera)
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, place, everything, view)
        for flag in _SWITCHED_OFF:
            view.flags[flag] = 0
        frame = mujoco.MjrRect(0, 0, width, height)
        pixels = np.empty((height, width, 3), dtype=np.uint8)
        mujoco.mjr_render(frame, view, context)
        mujoco.mjr_readPixels(pixels, None, frame, context)  # the bottom row comes first
        return pixels[:, ::-1] if camera in _ROLLED else pixels[::-1]

    def close(self) -> None:
        if self not in _open or os.getpid() not in _processes:
            return
        _open.remove(self)
        self._gl.make_current()
        for _, context in self._loaded.values():
            context.free()
        self._loaded = {}
        self._gl.free()


class SeenRows:
    """Base class for engines that provide camera images, and the MuJoCo model and body poses of each row."""

    _cameras: Cameras | None = None
    _fingers: ClassVar[dict[str, NDArray[np.bool_]]] = {}  # model file -> mask (bodies,) of the bodies that are fingers

    def _seen(self, row: int) -> tuple[RowModel, Any]:
        """Return a row's MuJoCo model (with the row's own positions of bodies and sites) and MuJoCo data."""
        raise NotImplementedError

    def render(self, rows: Sequence[int], *, camera: str, height: int, width: int) -> NDArray[np.uint8]:
        """Render the current states of ``rows`` and return the images (len(rows), height, width, 3) uint8."""
        cameras = self._cameras = self._cameras or Cameras()
        return np.stack([cameras.picture(*self._seen(row), camera=camera, height=height, width=width) for row in rows])

    def row_model(self, row: int) -> RowModel:
        """Return a row's MuJoCo model."""
        return self._seen(row)[0]

    def poses(self, row: int) -> BodyPoses:
        """Return the current poses of all bodies of a row."""
        data = self._seen(row)[1]
        return BodyPoses(data.xpos.copy(), data.xquat.copy())

    def touched(self, row: int) -> str | None:
        """Return the name of the root body that a row's fingers touch, or "nothing"; return None if no body name of the
        model contains "finger", "claw" or "pad"."""
        (path, model), data = self._seen(row)
        if path not in self._fingers:
            names = [model.body(body).name for body in range(model.nbody)]
            self._fingers[path] = np.array([bool(_FINGER.search(name)) for name in names])
        fingers = self._fingers[path]
        if not fingers.any():
            return None
        bodies = model.geom_bodyid[data.contact.geom]
        bodies = np.concatenate([bodies, bodies[:, ::-1]])
        roots = model.body_rootid[bodies]
        other = roots[fingers[bodies[:, 0]] & (roots[:, 0] != roots[:, 1]), 1]
        return model.body(int(other[0])).name if len(other) else "nothing"

    def close(self) -> None:
        if self._cameras is not None:
            self._cameras.close()
