"""pytest plug-in of tacsim: `pytest --policy mine.onnx --task squeeze` accepts a policy or not (docs/acceptance.md).

Every pytest session in an environment with tacsim loads this module. Without --policy it adds nothing: neither options,
which could be those of somebody's conftest.py, nor an import.
"""

from __future__ import annotations

import os
import shlex
from typing import Any

OPTION = "--policy"


def pytest_addoption(parser: Any, pluginmanager: Any) -> None:
    config = pluginmanager.get_plugin("pytestconfig")
    words = [*config.invocation_params.args, *shlex.split(os.environ.get("PYTEST_ADDOPTS", ""))]
    words += config.getini("addopts")
    if any(str(word).partition("=")[0] == OPTION for word in words):
        pluginmanager.import_plugin("robot.train.acceptance.pytest_items")
