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

_running: tuple[str, int] | None = None  # arch, process


def start(arch: str = "cpu", threads: int | None = None) -> str:
    """Starts Taichi if it does not run yet; returns the arch in use.

    Raises RuntimeError for a second arch in one process, and in a forked child, where kernels would hang.
    """
    global _running
    if _running is None:
        options = {} if threads is None else {"cpu_max_num_threads": threads}
        # ti.init prints "Starting on arch=..." whatever it is told; a command's output (JSON, say) must stay its own.
        with contextlib.redirect_stdout(io.StringIO()):
            # Without Taichi's own control-flow optimisation kernels compile in half the time and run as fast.
            ti.init(
                arch=getattr(ti, arch), default_fp=ti.f32, offline_cache=True, cfg_optimization=False,
                log_level=ti.ERROR, **options,
            )  # fmt: skip
        _running = (arch, os.getpid())
    if _running[1] != os.getpid():
        raise RuntimeError("Taichi does not survive a fork: start worker processes with the 'spawn' method")
    if _running[0] != arch:
        raise RuntimeError(f"Taichi already runs on '{_running[0]}' in this process; use another process for '{arch}'")
    return arch
