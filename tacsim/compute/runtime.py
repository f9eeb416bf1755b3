"""The only place that imports Taichi. It starts it once a process; all others do ``from tacsim.compute.runtime import
ti``.

A second ``ti.init`` in one process crashes it, and fork after a start hangs: hence one owner, and spawn for workers.
Its compiler works on one kernel at a time for the whole process, and takes no care of threads: hence `launching`.
"""

import atexit
import contextlib
import io
import os
import tempfile
import threading
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tacsim.compute import taichi_patches
from tacsim.compute.taichi_patches.front_end import light_import, replace_front_end
from tacsim.compute.taichi_patches.kernel_cache import repair_kernel_cache

os.environ.setdefault("TI_LOG_LEVEL", "error")
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")  # it would ask a server for news
if not {"HOME", "XDG_CACHE_HOME"} & os.environ.keys():  # Taichi ends the process without both
    os.environ["XDG_CACHE_HOME"] = str(Path("~/.cache").expanduser())

_patched = taichi_patches.are_enabled()
with (
    warnings.catch_warnings(),
    light_import() if _patched else contextlib.nullcontext(),
):  # Taichi 1.7 imports deprecated parts of the standard library and of NumPy
    warnings.simplefilter("ignore")
    import taichi as ti

if _patched:
    replace_front_end(ti.lang)

DEVICES = ("cpu", "cuda", "vulkan", "metal", "cpu-as-device")  # the last: what a device computes, without one
# Where worlds are computed, by TACSIM_DEVICE. Read once: kernels are written for it when their modules are imported.
DEVICE = os.environ.get("TACSIM_DEVICE") or "cpu"
# Where compiled kernels are kept from one process to the next, if it can be written
KERNELS = Path(os.environ.get("TI_OFFLINE_CACHE_FILE_PATH") or ti.lang.impl.default_cfg().offline_cache_file_path)
# What to do where it cannot
TO_KEEP = "make it writable, or set TI_OFFLINE_CACHE_FILE_PATH to a folder that is; until then every start compiles"

_running: int | None = None  # process
_launch_lock = threading.RLock()  # held by the thread that starts Taichi, compiles or launches


def start(cpu_only: str | None = None) -> str:
    """Starts Taichi on DEVICE if it does not run yet; returns DEVICE.

    cpu_only: what needs the CPU, in words, for the error that says so. Raises ValueError for an unknown device,
    RuntimeError for one that is not there, or where the CPU is needed; and in a forked child, where kernels would hang.
    """
    global _running
    _require_own_process()
    if DEVICE not in DEVICES:
        raise ValueError(f"TACSIM_DEVICE must be one of {', '.join(DEVICES)}, found '{DEVICE}'")
    if cpu_only is not None and DEVICE != "cpu":
        raise RuntimeError(f"{cpu_only} runs on the CPU only, but TACSIM_DEVICE is '{DEVICE}': unset it")
    with _launch_lock:
        if _running is None:
            _initialise()
            _running = os.getpid()
            atexit.register(_finish)
    return DEVICE


def _initialise() -> None:
    if not available(DEVICE):
        raise RuntimeError(
            f"TACSIM_DEVICE is '{DEVICE}', but Taichi finds no such device or driver on this machine; unset it to "
            f"compute on the CPU"
        )
    # Taichi crashes when the process ends where it cannot make the folder, even one in which it keeps nothing.
    kept = is_writable(KERNELS)
    if kept and _patched:
        repair_kernel_cache(KERNELS)
    if not kept:
        warnings.warn(f"compiled kernels cannot be kept: {KERNELS} is not writable; {TO_KEEP}", stacklevel=3)
    # ti.init prints "Starting on arch=..." whatever it is told; a command's output (JSON, say) must stay its own.
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            # Without Taichi's own control-flow optimisation kernels compile in half the time and run as fast.
            ti.init(
                arch=_architecture(DEVICE), default_fp=ti.f32, offline_cache=kept, cfg_optimization=False,
                offline_cache_file_path=str(KERNELS) if kept else tempfile.gettempdir(), log_level=ti.ERROR,
                enable_fallback=False,
            )  # fmt: skip
    except RuntimeError as error:
        if "memory allocation" not in str(error):
            raise
        raise RuntimeError(
            "Taichi cannot reserve the gigabyte of address space that it starts with: allow this process more "
            "(`ulimit -v unlimited`, or the memory limit of a job)"
        ) from error
    ti.sync()  # completes the start, which only this thread may do; kernels may then be compiled in any


def _finish() -> None:
    """Ends Taichi, which writes down what it has compiled only then, and not at all if something still refers to it
    when Python has ended. Half a minute of work would be lost."""
    if _running == os.getpid() and _launch_lock.acquire(timeout=10):  # for good: no thread launches after this
        ti.reset()


def is_writable(folder: Path) -> bool:
    """Whether files can be made in `folder`, which is made if need be."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


@contextlib.contextmanager
def launching() -> Iterator[None]:
    """Round every launch of kernels, and what prepares and reads it: threads take turns, which costs them nothing, for
    a launch holds the interpreter anyway. Raises RuntimeError in a forked child, where it would never return."""
    _require_own_process()
    with _launch_lock:
        yield


def _require_own_process() -> None:
    """Before any lock: in a forked child it may be held by a thread that is not there."""
    if _running not in (None, os.getpid()):
        raise RuntimeError(
            "Taichi runs in the parent process and does not survive a fork: start workers by 'spawn' or 'forkserver' "
            "(gymnasium.make_vec(..., vectorization_mode='async', vector_kwargs={'context': 'spawn'})), or before "
            "anything is simulated in the parent"
        )


def available(device: str) -> bool:
    """Whether Taichi can start on this one of DEVICES here."""
    return bool(ti.lang.misc.is_arch_supported(_architecture(device)))


def _architecture(device: str) -> Any:
    return getattr(ti, device.removesuffix("-as-device"))
