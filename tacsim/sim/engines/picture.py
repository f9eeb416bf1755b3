"""Pictures of a MuJoCo scene without a window: by EGL, or OSMesa where the machine has no graphics."""

from __future__ import annotations

import os
import sys
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np

from tacsim.interface import Image
from tacsim.sim.engines.mujoco_module import load_mujoco

MAX_BODIES = 5000  # in one picture
ADVICE = (
    "install one of them (Debian, Ubuntu: libegl1, or libosmesa6), or set MUJOCO_GL to egl, osmesa or glfw, or leave "
    "out `cameras`"
)


class NoRendering(RuntimeError):
    """This machine renders no pictures without a window."""


def make_context(width: int, height: int) -> Any:
    """An OpenGL context, made current. MUJOCO_GL says which; without it, EGL and then OSMesa are tried on Linux. Raises
    NoRendering with what each of them lacks."""
    load_mujoco()
    wanted = os.environ.get("MUJOCO_GL", "").lower().strip()
    if wanted in ("disable", "disabled", "off", "false", "0"):
        raise NoRendering(f"MUJOCO_GL={wanted} switches rendering off: unset it, or leave out `cameras`")
    names = {"linux": ["egl", "osmesa"], "darwin": ["cgl"]}.get(sys.platform, ["glfw"])
    if wanted in ("egl", "osmesa", "glfw", "cgl"):
        names = [wanted]
    failures = []
    for name in names:
        try:
            context = import_module(f"mujoco.{name}").GLContext(width, height)
            context.make_current()
        except Exception as failure:  # whatever a library of the machine raises that is not there
            failures.append(f"{name} ({type(failure).__name__}: {failure})")
        else:
            return context
    raise NoRendering(f"no off-screen rendering by {' or by '.join(failures)}: {ADVICE}")


@cache
def require_rendering() -> None:
    """Raises NoRendering where no picture can be rendered."""
    make_context(16, 16).free()


class PictureRenderer:
    """Renders one model, with the cameras that it names."""

    def __init__(self, model: Any, size: tuple[int, int]) -> None:
        """size: width, height [px], at most the model's off-screen buffer. Raises NoRendering."""
        mujoco = load_mujoco()
        self._model = model
        self._context = make_context(*size)
        self._render_context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._render_context)
        self._scene = mujoco.MjvScene(model, maxgeom=MAX_BODIES)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = True
        self._view, self._option = mujoco.MjrRect(0, 0, *size), mujoco.MjvOption()
        self._size = size

    def render(self, data: Any, camera: str) -> Image:
        """(H, W, 3) uint8 RGB of a camera. The frames of `data` must be computed, those of lights and cameras too."""
        mujoco = load_mujoco()
        seen = mujoco.MjvCamera()
        seen.type, seen.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, self._model.camera(camera).id
        self._context.make_current()
        mujoco.mjv_updateScene(
            self._model, data, self._option, None, seen, mujoco.mjtCatBit.mjCAT_ALL.value, self._scene
        )
        picture = np.empty((self._size[1], self._size[0], 3), np.uint8)
        mujoco.mjr_render(self._view, self._scene, self._render_context)
        mujoco.mjr_readPixels(picture, None, self._view, self._render_context)
        return picture[::-1].copy()

    def close(self) -> None:
        self._context.make_current()
        self._render_context.free()
        self._context.free()
