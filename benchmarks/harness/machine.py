"""The machine, the versions and the commit of a run."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path

from benchmarks.harness.cache import fingerprint
from benchmarks.harness.schema import Device, Group, Machine, Metadata
from robot.common import is_realtime_allowed

PACKAGES = ("tacsim", "taichi", "numpy", "scipy")  # whose versions are recorded
CODE = ("tacsim", "robot", "calibration")


class Run:
    """Data of a run. Make it when the run begins; call `metadata` when it has ended."""

    def __init__(self) -> None:
        self._began, self._load = time.perf_counter(), _load()
        self._commit, self._code = _commit(), fingerprint(*CODE)

    def metadata(
        self,
        groups: Sequence[Group],
        repeat: int,
        *,
        baselines: bool = False,
        long: bool = False,
        group_seconds: dict[Group, float] | None = None,
    ) -> Metadata:
        commit, modified = self._commit
        return Metadata(
            date=datetime.now(UTC).replace(microsecond=0),
            commit=commit,
            modified=modified,
            changed=fingerprint(*CODE) != self._code,
            versions=_versions(),
            machine=_machine(self._load),
            groups=list(groups),
            baselines=baselines,
            long=long,
            repeat=repeat,
            seconds=time.perf_counter() - self._began,
            group_seconds=group_seconds or {},
        )


def _versions() -> dict[str, str]:
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return versions


def _load() -> list[float] | None:
    return [round(value, 2) for value in os.getloadavg()] if hasattr(os, "getloadavg") else None


def _machine(load_before: list[float] | None) -> Machine:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    memory = None
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        memory = round(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 1e9, 1)
    system = f"{platform.system()} {platform.machine()}"
    return Machine(
        cpu=_cpu(),
        cores=cores,
        memory_gb=memory,
        system=system,
        load_before=load_before,
        load_after=_load(),
        realtime=is_realtime_allowed(),
        device=_device(),
    )


def backend() -> str:
    """The device of the processes of cases, as read by tacsim.compute.runtime, without importing Taichi."""
    return os.environ.get("TACSIM_DEVICE") or "cpu"


def _device() -> Device | None:
    """The GPU on which cases compute, or None for the CPU; its name if a tool reports it."""
    if backend() == "cpu":
        return None
    if backend() == "cuda":
        try:
            name, memory, driver = _nvidia()
        except (OSError, subprocess.SubprocessError, ValueError, IndexError):
            return Device(backend="cuda")
        size = round(int(memory) * 2**20 / 1e9, 1) if memory.isdecimal() else None  # None: shared with the host
        return Device(backend="cuda", name=name, memory_gb=size, driver=driver)
    return Device(backend=backend())


def _nvidia() -> list[str]:
    """Name, memory [MiB] and driver of the first visible GPU, which Taichi uses."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES", "").partition(",")[0]
    words = ["nvidia-smi", "--query-gpu=name,memory.total,driver_version", "--format=csv,noheader,nounits"]
    words += [f"--id={visible}"] if visible else []
    done = subprocess.run(words, capture_output=True, text=True, timeout=10, check=True)
    return [word.strip() for word in done.stdout.splitlines()[0].split(",")]


def _cpu() -> str:
    listed = Path("/proc/cpuinfo")
    if listed.exists():
        for line in listed.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine() or sys.platform


def _commit() -> tuple[str | None, bool | None]:
    """Commit of the checkout of this file, and whether it has changes; None for an installed package."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None, None
    try:
        commit = _git(root, "rev-parse", "--short=12", "HEAD")
        return commit, bool(_git(root, "status", "--porcelain", "--untracked-files=no"))
    except (OSError, subprocess.SubprocessError):
        return None, None


def _git(root: Path, *words: str) -> str:
    done = subprocess.run(["git", "-C", str(root), *words], capture_output=True, text=True, timeout=10, check=True)
    return done.stdout.strip()
