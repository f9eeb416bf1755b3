"""The only module that imports Taichi, and starts it once for each process; other modules import `ti` from here.

A second ``ti.init`` in one process crashes it, and a fork after the start hangs: therefore one owner, and spawn for
workers. Its compiler works on one kernel at a time in a process, and is not thread-safe: therefore `launching`.
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
from tacsim.compute.taichi_patches.front_end import import_without_optional_modules, replace_front_end
from tacsim.compute.taichi_patches.kernel_cache import repair_kernel_cache

os.environ.setdefault("TI_LOG_LEVEL", "error")
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")  # otherwise it requests the newest version from a server
if not {"HOME", "XDG_CACHE_HOME"} & os.environ.keys():  # Taichi ends the process if both are missing
    os.environ["XDG_CACHE_HOME"] = str(Path("~/.cache").expanduser())

_patched = taichi_patches.are_enabled()
with (
    warnings.catch_warnings(),
    import_without_optional_modules() if _patched else contextlib.nullcontext(),
):  # Taichi 1.7 imports deprecated parts of the standard library and of NumPy
    warnings.simplefilter("ignore")
    import taichi as ti

if _patched:
    replace_front_end(ti.lang)

DEVICES = ("cpu", "cuda", "vulkan", "metal", "cpu-as-device")  # the last: the code for a device, run on the CPU
# Device that computes worlds, from TACSIM_DEVICE. Read once: kernels are defined for it when their modules are
# imported.
DEVICE = os.environ.get("TACSIM_DEVICE") or "cpu"
# Folder of compiled kernels, which are used again by later processes, if it is writable
KERNELS = Path(os.environ.get("TI_OFFLINE_CACHE_FILE_PATH") or ti.lang.impl.default_cfg().offline_cache_file_path)
# Advice if it is not
CACHE_ADVICE = (
    "make it writable, or set TI_OFFLINE_CACHE_FILE_PATH to a folder that is; until then every start compiles"
)

_running: int | None = None  # process
_launch_lock = threading.RLock()  # held by the thread that starts Taichi, compiles or launches


def start_taichi(cpu_only: str | None = None) -> str:
    """Starts Taichi on DEVICE if it does not run yet; returns DEVICE.

    cpu_only: name of the part that needs the CPU, for the error message. Raises ValueError for an unknown device,
    RuntimeError for one that is not available, or where the CPU is needed; also in a forked child, where kernels would
    hang.
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
    if not is_available(DEVICE):
        raise RuntimeError(
            f"TACSIM_DEVICE is '{DEVICE}', but Taichi finds no such device or driver on this machine; unset it to "
            f"compute on the CPU"
        )
    # If Taichi cannot create the folder, it crashes at the end of the process, even without a cache.
    cached = is_writable(KERNELS)
    if cached and _patched:
        repair_kernel_cache(KERNELS)
    if not cached:
        warnings.warn(f"compiled kernels cannot be kept: {KERNELS} is not writable; {CACHE_ADVICE}", stacklevel=3)
    # ti.init always prints "Starting on arch=...", which must not be in the output of a command (such as JSON).
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            # Without Taichi's own control-flow optimisation kernels compile in half the time and run as fast.
            ti.init(
                arch=_architecture(DEVICE), default_fp=ti.f32, offline_cache=cached, cfg_optimization=False,
                offline_cache_file_path=str(KERNELS) if cached else tempfile.gettempdir(), log_level=ti.ERROR,
                enable_fallback=False,
            )  # fmt: skip
    except RuntimeError as error:
        if "memory allocation" not in str(error):
            raise
        raise RuntimeError(
            "Taichi cannot reserve the gigabyte of address space that it needs at its start: allow this process more "
            "(`ulimit -v unlimited`, or the memory limit of a job)"
        ) from error
    ti.sync()  # completes the start, which only this thread may do; all threads may compile kernels after that


def _finish() -> None:
    """Ends Taichi, which writes compiled kernels to its cache at its end only, and not at all if an object still refers
    to it when Python has ended. Otherwise half a minute of compilation would be lost."""
    if _running == os.getpid() and _launch_lock.acquire(timeout=10):  # never released: no thread launches after this
        ti.reset()


def is_writable(folder: Path) -> bool:
    """Whether files can be created in `folder`, which is created if it is missing."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


@contextlib.contextmanager
def launching() -> Iterator[None]:
    """Context of each launch of kernels, and of the code that prepares and reads it: one thread at a time, without
    loss, since a launch holds the interpreter lock. Raises RuntimeError in a forked child, where it would never
    return."""
    _require_own_process()
    with _launch_lock:
        yield


def _require_own_process() -> None:
    """Called before each lock: in a forked child, the lock may be held by a thread that does not exist."""
    if _running not in (None, os.getpid()):
        raise RuntimeError(
            "Taichi runs in the parent process and does not survive a fork: start workers by 'spawn' or 'forkserver' "
            "(gymnasium.make_vec(..., vectorization_mode='async', vector_kwargs={'context': 'spawn'})), or before "
            "anything is simulated in the parent"
        )


def is_available(device: str) -> bool:
    """Whether Taichi can start on this device, one of DEVICES, on this machine."""
    return bool(ti.lang.misc.is_arch_supported(_architecture(device)))


def _architecture(device: str) -> Any:
    return getattr(ti, device.removesuffix("-as-device"))
