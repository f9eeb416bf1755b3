"""Patches of Taichi's private parts: shorter starts and launches (docs/taichi-patches.md).

They apply to the versions in KNOWN_VERSIONS only. TACSIM_TAICHI_PATCHES=0 turns all of them off.
"""

import os
import warnings
from functools import cache
from importlib import metadata

KNOWN_VERSIONS = ("1.7.4",)


@cache
def are_enabled() -> bool:
    """Whether the patches apply in this process.

    Warns where the installed Taichi is none of KNOWN_VERSIONS. Raises ValueError if TACSIM_TAICHI_PATCHES is neither 0
    nor 1.
    """
    switch = os.environ.get("TACSIM_TAICHI_PATCHES") or "1"
    if switch not in ("0", "1"):
        raise ValueError(f"TACSIM_TAICHI_PATCHES must be 0 (off) or 1 (on), found '{switch}'")
    if switch == "0":
        return False
    try:
        version = metadata.version("taichi")
    except metadata.PackageNotFoundError:
        return False  # the import of Taichi says so
    if version not in KNOWN_VERSIONS:
        warnings.warn(
            f"Taichi {version} runs without tacsim's patches, which are known for {', '.join(KNOWN_VERSIONS)}: results "
            "agree to rounding, starts take longer (docs/taichi-patches.md)",
            stacklevel=2,
        )
        return False
    return True
