"""Kernels compiled by a process of their own."""

import os
import subprocess
import sys
from pathlib import Path


def run_script(script: Path, text: str, *arguments: str, kept: Path, **environment: str) -> tuple[str, set[str]]:
    """What a fresh process prints that runs `text`, written to `script`, on the CPU; and the names of the compiled
    kernels in the folder `kept`, where it looks for them and keeps them."""
    script.write_text(text, encoding="utf-8")
    inherited = {**os.environ, "TI_OFFLINE_CACHE_FILE_PATH": str(kept), "TACSIM_DEVICE": "cpu"}
    command = [sys.executable, "-W", "ignore", str(script), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, env=inherited | environment)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout, {each.name for each in kept.glob("*.tic")}
