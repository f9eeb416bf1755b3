"""Checks of the machine (what tacsim needs, whether it is available, and what to do if it is not), and of a rig of
hardware before anything moves. Each driver checks its own part; this module checks distances.

The checks send no command, so another program can drive the rig at the same time.
"""

from __future__ import annotations

import importlib
import os
import platform
import sys
import tempfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from robot.errors import DeviceError
from robot.rig.parts import arm_drivers, companion_of, sensor_drivers
from tacsim.interface import Pose
from tacsim.models.driver import Check, DriversMissing, installed_drivers
from tacsim.models.hardware import KeepOut
from tacsim.models.rig import RigConfig

PYTHONS = ((3, 11), (3, 14))  # from, up to but without
OPENCV = "opencv-contrib-python-headless"  # the distribution that provides cv2


def examine_machine() -> list[Check]:
    """All checks, in the order in which to correct problems. A check that raises an error counts as `fail`."""
    functions = (
        *(python, packages, drivers, robot_framework, second_opencv, opencv, taichi, ur_rtde),
        *(processors, realtime, working_directory),
    )
    return [check for function in functions for check in _run(function)]


def as_json(checks: Iterable[Check]) -> dict[str, Any]:
    """`{"ok": bool, "checks": [{name, state, found, advice}]}`; ok means that nothing failed."""
    listed = [asdict(check) for check in checks]
    return {"ok": all(check["state"] != "fail" for check in listed), "checks": listed}


def _run(function: Callable[[], list[Check]]) -> list[Check]:
    try:
        return function()
    except Exception as error:  # a broken installation can fail with any error; the error is the result of the check
        name = function.__name__.replace("_", " ")
        advice = "reinstall the packages: make run builds the environment again"
        return [Check(name, "fail", f"{type(error).__name__}: {error}", advice)]


def python() -> list[Check]:
    """Version of the interpreter."""
    low, high = PYTHONS
    found = f"{platform.python_version()} at {sys.executable}"
    if low <= sys.version_info[:2] < high:
        return [Check("python", "ok", found)]
    span = f"{low[0]}.{low[1]} to {high[0]}.{high[1] - 1}"
    return [Check("python", "fail", found, f"use Python {span}, for example: make run PYTHON=python3.12")]


def packages(distribution: str = "tacsim") -> list[Check]:
    """Installed versions against what the distribution requires on this machine."""
    try:
        lines = metadata.requires(distribution) or []
    except metadata.PackageNotFoundError:
        advice = "install it, from the checkout: python -m pip install -e ."
        return [Check("packages", "warn", f"{distribution} itself is not installed; its pins are unknown", advice)]
    wanted = [Requirement(line) for line in lines]
    needed = [need for need in wanted if need.marker is None or need.marker.evaluate({"extra": ""})]
    return [_package(need) for need in needed]


def _package(need: Requirement) -> Check:
    name, advice = f"package {need.name}", f"python -m pip install '{need.name}{need.specifier}'"
    try:
        version = metadata.version(need.name)
    except metadata.PackageNotFoundError:
        return Check(name, "fail", "not installed", advice)
    if need.specifier.contains(version, prereleases=True):
        return Check(name, "ok", version)
    return Check(name, "fail", f"{version}, but {need.specifier} is needed", advice)


def drivers() -> list[Check]:
    """The installed drivers of sensors and arms, and the reasons why others are refused."""
    try:
        found = installed_drivers()
    except DriversMissing as missing:
        return [Check("drivers", "fail", "those of tacsim are not registered", str(missing))]
    words = "; ".join(f"{kind}s {', '.join(each)}" for kind, each in found.usable.items())
    refused = [
        Check(f"driver {kind} {name}", "warn", f"refused: {reason}", "repair or uninstall its distribution")
        for kind, each in found.refused.items()
        for name, reason in each.items()
    ]
    return [Check("drivers", "ok", words), *refused]


def robot_framework() -> list[Check]:
    """Robot Framework installs a package `robot`, too: its files replace ours, or ours replace its."""
    try:
        version = metadata.version("robotframework")
    except metadata.PackageNotFoundError:
        return [Check("one robot", "ok", "no other package named robot")]
    advice = (
        "install one of them into another environment. Here: python -m pip uninstall -y robotframework; "
        "python -m pip install --force-reinstall --no-deps tacsim"
    )
    found = f"robotframework {version} has a package `robot`, too; both installed files into one folder"
    return [Check("one robot", "fail", found, advice)]


def second_opencv() -> list[Check]:
    """Other opencv-* distributions write into the same cv2 folder. With different versions, the order of installation
    decides which files remain."""
    installed = {str(canonicalize_name(each.name)): each.version for each in metadata.distributions() if each.name}
    others = sorted(name for name in installed if name.startswith("opencv-") and name != OPENCV)
    if not others:
        return [Check("one cv2", "ok", "no other opencv package")]
    own_version = installed.get(OPENCV, "")
    found = f"{', '.join(f'{name} {installed[name]}' for name in others)} in addition to {OPENCV} {own_version}"
    if all(installed[name] == own_version for name in others):
        return [Check("one cv2", "ok", f"{found}: the same version")]
    same_version = " ".join(f"{name}=={own_version}" for name in others)
    advice = (
        f"if nothing needs it: python -m pip uninstall -y {' '.join(others)}; else install one version of all: "
        f"python -m pip install {same_version}. Then: python -m pip install --force-reinstall --no-deps "
        f"{OPENCV}=={own_version}"
    )
    return [Check("one cv2", "fail", found, advice)]


def opencv() -> list[Check]:
    """cv2 can be imported and has hand-eye calibration (missing in 5.0.0.93)."""
    import cv2

    found = f"{cv2.__version__} at {Path(cv2.__file__).parent}"
    if hasattr(cv2, "calibrateHandEye"):
        return [Check("cv2.calibrateHandEye", "ok", found)]
    return [
        Check("cv2.calibrateHandEye", "fail", f"missing in {found}", f"python -m pip install '{OPENCV}>=4.13,<4.14'")
    ]


def taichi() -> list[Check]:
    """Whether Taichi starts, on which arch, and where it stores compiled kernels."""
    if sys.platform == "linux" and platform.machine() == "aarch64":
        advice = "simulate on another machine; hardware and replay work here"
        return [Check("taichi", "warn", "no Taichi wheel exists for linux aarch64", advice)]
    from tacsim.compute.runtime import DEVICE, KERNELS, is_available, start_taichi, ti
    from tacsim.compute.taichi_patches import are_enabled

    if not is_available(DEVICE):
        advice = "unset TACSIM_DEVICE to compute on the processor, or install the device's driver"
        return [Check("taichi", "fail", f"TACSIM_DEVICE is '{DEVICE}', which is not available", advice)]
    arch = start_taichi()
    version = ".".join(str(part) for part in ti.__version__)
    patches = "" if are_enabled() else ", without patches (docs/taichi-patches.md)"
    return [Check("taichi", "ok", f"{version}, arch {arch}{patches}"), kernel_cache(KERNELS)]


def kernel_cache(folder: Path) -> Check:
    """The folder of compiled kernels: without it every start compiles for tens of seconds."""
    from tacsim.compute.runtime import CACHE_ADVICE, is_writable

    if not is_writable(folder):
        return Check("kernel cache", "warn", f"{folder} is not writable", CACHE_ADVICE)
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    return Check("kernel cache", "ok", f"{folder}, {size / 1e6:.1f} MB" + ("" if size else " (first run compiles)"))


def ur_rtde() -> list[Check]:
    """The library of the UR arms can be imported."""
    try:
        for module in ("rtde_control", "rtde_receive"):
            importlib.import_module(module)
    except ImportError as error:
        advice = "UR arms can't be driven from here (wheels: Linux x86_64, Windows; Python below 3.13); the rest works"
        return [Check("ur_rtde", "warn", str(error), advice)]
    return [Check("ur_rtde", "ok", metadata.version("ur_rtde"))]


def processors() -> list[Check]:
    """CPU cores that this process may use."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if count > 1:
        return [Check("processors", "ok", f"{count}")]
    return [Check("processors", "warn", f"{count}", "simulation needs two or more; expect it to be slow")]


def realtime() -> list[Check]:
    """Whether the processes that control arms may use real-time priority."""
    from robot.common import is_realtime_allowed

    if is_realtime_allowed():
        return [Check("real-time priority", "ok", "allowed")]
    advice = (
        "only arms need it: their 2 ms loop then waits for other programs. Allow it by `USER - rtprio 20` in "
        "/etc/security/limits.conf (then log in again), or CAP_SYS_NICE for a container"
    )
    return [Check("real-time priority", "warn", "not allowed", advice)]


def working_directory() -> list[Check]:
    """Episodes are written below the working directory."""
    folder = Path.cwd()
    try:
        with tempfile.TemporaryFile(dir=folder):
            return [Check("write permission", "ok", str(folder))]
    except OSError as error:
        advice = "change to a folder that you can write to, or give --out"
        return [Check("write permission", "fail", f"{folder}: {error.strerror}", advice)]


def examine_rig(config: RigConfig, file: str | None = None) -> list[Check]:
    """All checks of one rig. The mocks of its file run while the checks do.

    file: name of the rig on the command line, for the commands in the advice.
    """
    if config.clock == "mujoco":
        return mujoco_checks(config)
    if config.clock != "wall":
        return [Check("rig", "ok", f"'{config.name}' has no hardware: nothing to check")]
    try:
        with companion_of(config) as companion:
            starts = {} if companion is None else companion.start_poses
            checks = examine_arms(config, starts, file or config.name)
            for driver in sensor_drivers(config).values():
                checks += driver.checks()
    except (DeviceError, ValueError, RuntimeError) as failure:
        return [Check("rig", "fail", str(failure), "correct the rig file")]
    return checks


def mujoco_checks(config: RigConfig) -> list[Check]:
    """MuJoCo, and how it renders pictures for the cameras of a rig."""
    from tacsim.sim.engines.mujoco_module import load_mujoco
    from tacsim.sim.engines.picture import NoRendering, require_rendering

    try:
        found = [Check("MuJoCo", "ok", f"version {load_mujoco().__version__}")]
    except ImportError as failure:
        return [Check("MuJoCo", "fail", str(failure), "install the extra: pip install 'tacsim[mujoco]'")]
    if config.cameras:
        try:
            require_rendering()
            found.append(Check("pictures", "ok", f"of cameras {', '.join(config.cameras)}, without a window"))
        except NoRendering as failure:
            found.append(Check("pictures", "fail", str(failure), "install libegl1 or libosmesa6, or leave out cameras"))
    return found


def examine_arms(config: RigConfig, starts: Mapping[str, Pose], file: str) -> list[Check]:
    """The checks of the arms alone. starts: start poses from the scene of a mock rig."""
    found = {
        name: driver.examine(config.arms[name].start_pose or starts.get(name), file)
        for name, driver in arm_drivers(config).items()
    }
    poses = {name: each.sensor_pose for name, each in found.items() if each.sensor_pose is not None}
    pairs = [check_keep_out(rule, poses, file) for rule in config.keep_out if set(rule.arms) <= set(poses)]
    return [*(check for each in found.values() for check in each.checks), *pairs]


def check_keep_out(rule: KeepOut, poses: Mapping[str, Pose], file: str) -> Check:
    """Checks that the sensors of two arms at `poses` are farther apart than the keep-out distance."""
    first, second = rule.arms
    gap = float(np.linalg.norm(poses[first].position - poses[second].position))
    words = f"the sensors are {1e3 * gap:.0f} mm apart, at least {1e3 * rule.distance:g} mm are required"
    label = f"{first}, {second}: keep-out"
    if gap > rule.distance:
        return Check(label, "ok", words)
    return Check(label, "fail", words, f"`tacsim start {file}` moves it to its start, after you confirm")
