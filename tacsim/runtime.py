"""The only place that imports Taichi. It starts it once a process; all others do ``from tacsim.runtime import ti``.

A second ``ti.init`` in one process crashes it, and fork after a start hangs: hence one owner, and spawn for workers.
"""

import contextlib
import io
import os
import warnings

os.environ.setdefault("TI_LOG_LEVEL", "error")
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")

with warnings.catch_warnings():  # Taichi 1.7 imports deprecated parts of the standard library and of NumPy
    warnings.simplefilter("ignore")
    import taichi as ti

DEVICES = ("cpu", "cuda", "vulkan", "metal")
# Where worlds are computed, by TACSIM_DEVICE. Read once: kernels are written for it when their modules are imported.
DEVICE = os.environ.get("TACSIM_DEVICE") or "cpu"

_running: int | None = None  # process


def start(cpu_only: str | None = None) -> str:
    """Starts Taichi on DEVICE if it does not run yet; returns DEVICE.

    cpu_only: what needs the CPU, in words, for the error that says so. Raises ValueError for an unknown device,
    RuntimeError for one that is not there, or where the CPU is needed; and in a forked child, where kernels would hang.
    """
    global _running
    if DEVICE not in DEVICES:
        raise ValueError(f"TACSIM_DEVICE must be one of {', '.join(DEVICES)}, found '{DEVICE}'")
    if cpu_only is not None and DEVICE != "cpu":
        raise RuntimeError(f"{cpu_only} runs on the CPU only, but TACSIM_DEVICE is '{DEVICE}': unset it")
    if _running is None:
        if not available(DEVICE):
            raise RuntimeError(
                f"TACSIM_DEVICE is '{DEVICE}', but Taichi finds no such device or driver on this machine; unset it to "
                f"compute on the CPU"
            )
        # ti.init prints "Starting on arch=..." whatever it is told; a command's output (JSON, say) must stay its own.
        with contextlib.redirect_stdout(io.StringIO()):
            # Without Taichi's own control-flow optimisation kernels compile in half the time and run as fast.
            ti.init(
                arch=getattr(ti, DEVICE), default_fp=ti.f32, offline_cache=True, cfg_optimization=False,
                log_level=ti.ERROR, enable_fallback=False,
            )  # fmt: skip
        _running = os.getpid()
    if _running != os.getpid():
        raise RuntimeError("Taichi does not survive a fork: start worker processes with the 'spawn' method")
    return DEVICE


def available(device: str) -> bool:
    """Whether Taichi can start on this one of DEVICES here."""
    return bool(ti.lang.misc.is_arch_supported(getattr(ti, device)))
