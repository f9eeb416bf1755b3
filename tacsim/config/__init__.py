"""Configuration: YAML files -> frozen models. Files refer to each other by name; ``key.sub=value`` overrides any value.

A file may say ``scene: squeeze`` (the shipped file ``configs/scenes/squeeze.yaml``), ``scene: mine.yaml`` (a file below
its own folder), ``scene: {extends: squeeze, preset: standard}`` (that file with changes), or write the mapping out.
Every problem is a line ``file:line: key: what is wrong; what is allowed; did you mean``, all in one ConfigError.
"""

from tacsim.config.errors import ConfigError
from tacsim.config.kinds import KINDS, config_root, json_schema, names
from tacsim.config.load import LoadedRig, load, load_rig, load_scene, load_sensor, load_task

__all__ = [
    "KINDS",
    "ConfigError",
    "LoadedRig",
    "config_root",
    "json_schema",
    "load",
    "load_rig",
    "load_scene",
    "load_sensor",
    "load_task",
    "names",
]
