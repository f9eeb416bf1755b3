"""Repairs Taichi's folder of compiled kernels, whose format is private to Taichi."""

import contextlib
import re
import time
from pathlib import Path

# A kernel's key, its length before it, twice, then the size of its file
ENTRY = re.compile(rb"(T[0-9a-f]{64})A\0{7}\1(.{8})", re.DOTALL)


def repair_kernel_cache(folder: Path) -> None:
    """Removes what would make Taichi neither read nor write compiled kernels in `folder`.

    Without the repair each process compiles for up to a minute and says nothing. The lock of a killed process is never
    removed by Taichi, and a kernel that the index lists is never written again, even if its file is lost or cut.
    """
    max_lock_age = 60  # of a lock whose process still runs; Taichi holds it for milliseconds [s]
    lock, index = folder / "ticache.lock", folder / "ticache.tcb"
    with contextlib.suppress(OSError):
        if abs(time.time() - lock.stat().st_mtime) > max_lock_age:
            lock.unlink()
    with contextlib.suppress(OSError):
        for key, size in ENTRY.findall(index.read_bytes()):
            file = folder / f"{key.decode()}.tic"
            if not file.is_file() or file.stat().st_size != int.from_bytes(size, "little"):
                index.unlink()
                return
