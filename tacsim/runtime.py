"""The only place that imports Taichi. It starts Taichi once a process; everybody else does ``from tacsim.runtime import ti``.

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

_started: str | None = None


def start(arch: str = "cpu", threads: int | None = None) -> str:
    """Starts Taichi if it is not yet running; returns the arch in use. Raises RuntimeError on a second, different request."""
    global _started
    if _started is None:
        options = {} if threads is None else {"cpu_max_num_threads": threads}
        # ti.init prints "Starting on arch=..." whatever it is told; a command's output (JSON, say) must stay its own.
        with contextlib.redirect_stdout(io.StringIO()):
            ti.init(arch=getattr(ti, arch), default_fp=ti.f32, offline_cache=True, log_level=ti.ERROR, **options)
        _started = arch
    elif _started != arch:
        raise RuntimeError(f"Taichi already runs on '{_started}' in this process; start another process for '{arch}'")
    return _started


def forbid_fork() -> None:
    """After a fork a child's kernels hang; fail there at once, with advice."""

    def after_fork() -> None:
        raise RuntimeError("Taichi does not survive a fork: use the 'spawn' start method (multiprocessing, vector environments)")

    os.register_at_fork(after_in_child=after_fork)
