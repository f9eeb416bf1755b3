"""Configuration: YAML files -> frozen models. Files refer to each other by name; ``key.sub=value`` overrides any value.

A file may say ``scene: squeeze`` (the shipped file ``configs/scenes/squeeze.yaml``), ``scene: mine.yaml`` (a file below
its own folder), ``scene: {extends: squeeze, preset: standard}`` (that file with changes), or write the mapping out.
Every problem is a line ``file:line: key: what is wrong; what is allowed; did you mean``, all in one ConfigError.
"""

from tacsim.config.document import ConfigError as ConfigError
from tacsim.config.kinds import KINDS as KINDS
from tacsim.config.kinds import config_root as config_root
from tacsim.config.kinds import json_schema as json_schema
from tacsim.config.kinds import shipped_names as shipped_names
from tacsim.config.load import LoadedRig as LoadedRig
from tacsim.config.load import load_model as load_model
from tacsim.config.load import load_rig as load_rig
from tacsim.config.load import load_scene as load_scene
from tacsim.config.load import load_sensor as load_sensor
from tacsim.config.load import load_task as load_task
