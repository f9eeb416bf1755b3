"""Opens, runs and records rigs of all kinds: real arms and cameras, mocks of them, simulations, recordings.

The names below are public: ``from robot import open_rig, make_env, load_policy``; mock devices are in `robot.mock`. A
module is imported when one of its names is used. The paths of modules are private and may change from one version to
the next.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING


def _require_own_packages() -> None:
    """Raises ImportError if a file or folder of the same name would be imported instead of a package of tacsim: the
    folder of a script comes before the installed packages on Python's path."""
    here = Path(__file__).resolve().parent.parent
    for package in ("tacsim", "calibration"):
        spec = find_spec(package)
        found = None if spec is None or spec.origin is None else Path(spec.origin).resolve()
        if found != here / package / "__init__.py":
            raise ImportError(
                f"'{package}' is {found}, not the package of tacsim at {here}: rename yours, or run from another folder"
            )


_require_own_packages()

if TYPE_CHECKING:
    from robot.arm.ur import URArm as URArm
    from robot.camera.camera import Camera as Camera
    from robot.camera.camera import StaleFrame as StaleFrame
    from robot.deploy.control_loop import EpisodeFailed as EpisodeFailed
    from robot.deploy.control_loop import EpisodeSetup as EpisodeSetup
    from robot.deploy.control_loop import RecordingFailed as RecordingFailed
    from robot.deploy.control_loop import run_episode as run_episode
    from robot.deploy.policy import PolicyNotFound as PolicyNotFound
    from robot.deploy.policy import load_policy as load_policy
    from robot.deploy.python_policy import FunctionPolicy as FunctionPolicy
    from robot.errors import DeviceAlreadyConnectedError as DeviceAlreadyConnectedError
    from robot.errors import DeviceBusyError as DeviceBusyError
    from robot.errors import DeviceError as DeviceError
    from robot.errors import DeviceNotConnectedError as DeviceNotConnectedError
    from robot.errors import EmergencyStop as EmergencyStop
    from robot.errors import LinkLost as LinkLost
    from robot.errors import ProtectiveStop as ProtectiveStop
    from robot.errors import SafetyViolation as SafetyViolation
    from robot.errors import StaleObservationError as StaleObservationError
    from robot.export.lerobot_env import LeRobotEnv as LeRobotEnv
    from robot.export.lerobot_rig import Jog as Jog
    from robot.export.lerobot_rig import LeRobotRig as LeRobotRig
    from robot.export.lerobot_rig import TactileCamera as TactileCamera
    from robot.open import CannotOpen as CannotOpen
    from robot.open import check_sensors as check_sensors
    from robot.open import make_env as make_env
    from robot.open import make_sharded_env as make_sharded_env
    from robot.open import make_vector_env as make_vector_env
    from robot.open import open_rig as open_rig
    from robot.studies.press import PressMotion as PressMotion
    from robot.studies.press import PressResult as PressResult
    from robot.studies.press import press as press
else:
    from tacsim.lazy import public_names

    __getattr__, __dir__ = public_names(__name__)
