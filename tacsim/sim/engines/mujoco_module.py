"""MuJoCo, the extra `mujoco`: imported when something of it is asked for."""

from __future__ import annotations

import os
from functools import cache
from typing import Any

MAJOR = 4  # whose interface is known here


@cache
def load_mujoco() -> Any:
    """The module. Raises ImportError where it is missing, cannot be loaded, or has another major version than MAJOR."""
    try:
        import mujoco
    except ImportError as error:
        raise ImportError(
            f"MuJoCo is missing ({error}): install the extra, pip install 'tacsim[mujoco]', or pip install "
            f"'mujoco>={MAJOR},<{MAJOR + 1}'"
        ) from error
    except Exception as error:  # of the graphics library that MUJOCO_GL names, which it loads at once
        wanted = os.environ.get("MUJOCO_GL")
        advice = f"; MUJOCO_GL is '{wanted}': unset it, or set egl, osmesa or glfw, whichever is installed"
        words = f"MuJoCo cannot be loaded ({type(error).__name__}: {error})"
        raise ImportError(words + (advice if wanted else "")) from error
    require_major(str(getattr(mujoco, "__version__", "unknown")))
    return mujoco


def require_major(version: str) -> None:
    """Raises ImportError for a version of MuJoCo with another major number."""
    if version.partition(".")[0] != str(MAJOR):
        raise ImportError(
            f"MuJoCo {version} is installed, but tacsim is written for version {MAJOR}: pip install "
            f"'mujoco>={MAJOR},<{MAJOR + 1}'"
        )
