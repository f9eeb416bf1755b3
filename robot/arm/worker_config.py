"""Converts an arm of a rig file to the configuration of its worker, and checks its host."""

from __future__ import annotations

import os
from collections.abc import Sequence

from robot.arm.channel import Partner, WorkerConfig
from robot.common import MOCK_SERIAL, is_loopback
from robot.common.kinematics import pose
from robot.errors import DeviceNotConnectedError
from tacsim import pose as se3
from tacsim.interface import FloatArray
from tacsim.models.hardware import UrArmConfig


def check_host(config: UrArmConfig, name: str) -> None:
    """Raises DeviceNotConnectedError unless a mock or simulator is on loopback and a real arm is not."""
    loopback = is_loopback(config.host)
    if config.mock is not None and not loopback:
        raise DeviceNotConnectedError(
            f"arm '{name}' has a `mock:` block, but its host {config.host} is outside this machine; a mock's host is a "
            "loopback address such as 127.0.0.2. Remove `mock:` to talk to the real arm"
        )
    if config.simulator and not loopback:
        raise DeviceNotConnectedError(
            f"arm '{name}' is declared as a simulator (`simulator: true`), but its host {config.host} is outside this "
            "machine, where a real arm may answer; remove `simulator: true`, or give the simulator's loopback address"
        )
    if config.mock is None and not config.simulator and loopback:
        raise DeviceNotConnectedError(
            f"arm '{name}' is a real arm, but its host {config.host} is this machine; give its address, or add `mock: "
            "{}` for a mock controller, or `simulator: true` for the maker's simulator (URSim)"
        )


def make_worker_config(
    config: UrArmConfig,
    name: str,
    segment: int,
    partners: Sequence[Partner],
    start_path: tuple[FloatArray, FloatArray] | None = None,
) -> WorkerConfig:
    """`start_path`: joints (6,) at both ends of the only allowed path, straight; None: it follows commands."""
    limits, tool = config.limits, se3.to_matrix(config.flange_from_tool.pose)
    return WorkerConfig(
        name=name,
        host=config.host,
        model=config.model,
        refused_serial=MOCK_SERIAL if config.mock is None else None,
        # URSim shares this machine: a worker with real-time priority would slow it down.
        realtime=not config.simulator if config.mock is None else config.mock.realtime,
        parent=os.getpid(),
        segment=segment,
        world_from_base=se3.to_matrix(config.world_from_base.pose).tolist(),
        flange_from_tool=tool.tolist(),
        tool_from_sensor=se3.to_matrix(config.tool_from_sensor.pose).tolist(),
        tcp=pose(tool).tolist(),
        mass=config.payload.mass,
        mass_centre=list(config.payload.centre),
        lower=list(limits.workspace.lower),
        upper=list(limits.workspace.upper),
        planes=[[list(wall.point), list(wall.normal)] for wall in limits.planes],
        speed=limits.speed,
        turn_rate=limits.turn_rate,
        acceleration=limits.acceleration,
        turn_acceleration=limits.turn_acceleration,
        joint_speed=limits.joint_speed,
        force=limits.force,
        torque=limits.torque,
        following_error=limits.max_following_error,
        following_turn=limits.max_following_turn,
        depth=limits.depth,
        shear=limits.shear,
        link_timeout=config.link_timeout,
        action_timeout=config.action_timeout,
        observation_timeout=config.observation_timeout,
        watchdog=config.watchdog,
        lookahead=config.lookahead,
        gain=config.gain,
        partners=list(partners),
        serial=config.serial,
        start_path=None if start_path is None else [end.tolist() for end in start_path],
    )
