"""Gymnasium environments. An import of this package registers them; so does its name in an id, also in a process that
imports nothing else: ``gymnasium.make("tacsim.gym:tacsim/Squeeze-v0")``."""

from tacsim.gym.plugin import register_envs

register_envs()
