"""Rigs of three kinds: simulated, recorded, and hardware (real or mock). `robot.open` chooses."""

RIG_ATTACHMENT = "rig.yaml"  # of an episode: the resolved rig file it was recorded with


class CannotOpen(ValueError):
    """A valid rig file describes a rig that cannot be opened."""
