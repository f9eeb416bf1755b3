"""The contract between tactile rigs and policies, the simulator, the tasks, and the record of episodes.

The names below are public: ``from tacsim import Observation, Action, Rig``. A module is imported when a name of it is
asked for. The paths of modules are private and may change from one version to the next.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from tacsim.lazy import public_names

if TYPE_CHECKING:
    from tacsim import pose as pose
    from tacsim.config import ConfigError as ConfigError
    from tacsim.config import LoadedRig as LoadedRig
    from tacsim.config import config_root as config_root
    from tacsim.config import json_schema as json_schema
    from tacsim.config import load_rig as load_rig
    from tacsim.config import load_scene as load_scene
    from tacsim.config import load_sensor as load_sensor
    from tacsim.config import load_task as load_task
    from tacsim.control import NoTouch as NoTouch
    from tacsim.control import contact_signal as contact_signal
    from tacsim.gym.env import TacsimEnv as TacsimEnv
    from tacsim.gym.features import FeatureEncoder as FeatureEncoder
    from tacsim.gym.vector import TacsimVectorEnv as TacsimVectorEnv
    from tacsim.interface import Action as Action
    from tacsim.interface import Arm as Arm
    from tacsim.interface import ArmState as ArmState
    from tacsim.interface import Clock as Clock
    from tacsim.interface import EndOfEpisode as EndOfEpisode
    from tacsim.interface import GelReading as GelReading
    from tacsim.interface import Gripper as Gripper
    from tacsim.interface import GripperState as GripperState
    from tacsim.interface import GripperTarget as GripperTarget
    from tacsim.interface import HardwareArm as HardwareArm
    from tacsim.interface import IncompatibleRig as IncompatibleRig
    from tacsim.interface import Needs as Needs
    from tacsim.interface import Normaliser as Normaliser
    from tacsim.interface import Observation as Observation
    from tacsim.interface import Policy as Policy
    from tacsim.interface import Pose as Pose
    from tacsim.interface import RigSpec as RigSpec
    from tacsim.interface import SensorSpec as SensorSpec
    from tacsim.interface import SurfaceMap as SurfaceMap
    from tacsim.interface import TactileFrame as TactileFrame
    from tacsim.interface import TactileObservation as TactileObservation
    from tacsim.interface import TactileSource as TactileSource
    from tacsim.interface import Truth as Truth
    from tacsim.interface import View as View
    from tacsim.limits import ActionError as ActionError
    from tacsim.limits import LimitExceeded as LimitExceeded
    from tacsim.models.driver import ArmDriver as ArmDriver
    from tacsim.models.driver import ArmExamination as ArmExamination
    from tacsim.models.driver import Check as Check
    from tacsim.models.driver import Companion as Companion
    from tacsim.models.driver import SensorDriver as SensorDriver
    from tacsim.models.hardware import ArmConfig as ArmConfig
    from tacsim.models.hardware import CameraSensorConfig as CameraSensorConfig
    from tacsim.models.hardware import GripperConfig as GripperConfig
    from tacsim.models.hardware import KeepOut as KeepOut
    from tacsim.models.hardware import Placement as Placement
    from tacsim.models.hardware import SensorConfig as SensorConfig
    from tacsim.models.hardware import UrArmConfig as UrArmConfig
    from tacsim.models.limits import ArmLimits as ArmLimits
    from tacsim.models.limits import Workspace as Workspace
    from tacsim.models.material import BodyMaterial as BodyMaterial
    from tacsim.models.material import GelMaterial as GelMaterial
    from tacsim.models.policy import Features as Features
    from tacsim.models.policy import MapGrid as MapGrid
    from tacsim.models.quantity import Length as Length
    from tacsim.models.randomisation import Randomisation as Randomisation
    from tacsim.models.rig import ReplayArmConfig as ReplayArmConfig
    from tacsim.models.rig import ReplayGripperConfig as ReplayGripperConfig
    from tacsim.models.rig import ReplaySensorConfig as ReplaySensorConfig
    from tacsim.models.rig import RigConfig as RigConfig
    from tacsim.models.rig import SimArmConfig as SimArmConfig
    from tacsim.models.rig import SimSensorConfig as SimSensorConfig
    from tacsim.models.scene import Body as Body
    from tacsim.models.scene import Box as Box
    from tacsim.models.scene import Cylinder as Cylinder
    from tacsim.models.scene import Gel as Gel
    from tacsim.models.scene import GelSurface as GelSurface
    from tacsim.models.scene import Indenter as Indenter
    from tacsim.models.scene import Mesh as Mesh
    from tacsim.models.scene import Scene as Scene
    from tacsim.models.scene import Settling as Settling
    from tacsim.models.scene import Sphere as Sphere
    from tacsim.models.sensor import CameraNoise as CameraNoise
    from tacsim.models.sensor import CanonicalGrid as CanonicalGrid
    from tacsim.models.sensor import Light as Light
    from tacsim.models.sensor import Lighting as Lighting
    from tacsim.models.sensor import Markers as Markers
    from tacsim.models.sensor import SensorGeometry as SensorGeometry
    from tacsim.models.sensor import SensorModel as SensorModel
    from tacsim.models.task import KneadConfig as KneadConfig
    from tacsim.models.task import LengthenConfig as LengthenConfig
    from tacsim.models.task import ReliefConfig as ReliefConfig
    from tacsim.models.task import RepositionConfig as RepositionConfig
    from tacsim.models.task import SqueezeConfig as SqueezeConfig
    from tacsim.models.task import TaskConfig as TaskConfig
    from tacsim.optics.render import Renderer as Renderer
    from tacsim.optics.surface import surface_map as surface_map
    from tacsim.physics.failure.health import SimulationDiverged as SimulationDiverged
    from tacsim.physics.grip.model import GripCommand as GripCommand
    from tacsim.physics.grip.model import GuideSupport as GuideSupport
    from tacsim.physics.grip.model import HeldObject as HeldObject
    from tacsim.physics.grip.model import HeldStates as HeldStates
    from tacsim.physics.grip.model import Support as Support
    from tacsim.physics.grip.model import facing_pads as facing_pads
    from tacsim.physics.motion.load import LoadNotReached as LoadNotReached
    from tacsim.physics.move import MoveStats as MoveStats
    from tacsim.physics.world import World as World
    from tacsim.physics.world import make_world as make_world
    from tacsim.physics.worlds.batch import Batch as Batch
    from tacsim.record.episode import Episode as Episode
    from tacsim.record.episode import EpisodeError as EpisodeError
    from tacsim.record.episode import EpisodeMeta as EpisodeMeta
    from tacsim.record.episode import Step as Step
    from tacsim.record.reader import iter_steps as iter_steps
    from tacsim.record.reader import read_episode as read_episode
    from tacsim.record.writer import Recorder as Recorder
    from tacsim.report.report import write_report as write_report
    from tacsim.rig import Reset as Reset
    from tacsim.rig import Rig as Rig
    from tacsim.sim.engines.touch import ObjectDropped as ObjectDropped
    from tacsim.sim.engines.touch import TouchSensor as TouchSensor
    from tacsim.sim.engines.touch import step_each as step_each
    from tacsim.sim.engines.touch import step_together as step_together
    from tacsim.sim.held import HeldObjects as HeldObjects
    from tacsim.sim.pads import TactilePads as TactilePads
    from tacsim.tasks import Axis as Axis
    from tacsim.tasks import Estimator as Estimator
    from tacsim.tasks import GripAxis as GripAxis
    from tacsim.tasks import Knead as Knead
    from tacsim.tasks import Lengthen as Lengthen
    from tacsim.tasks import Outcome as Outcome
    from tacsim.tasks import Relief as Relief
    from tacsim.tasks import Reposition as Reposition
    from tacsim.tasks import Squeeze as Squeeze
    from tacsim.tasks import Task as Task
    from tacsim.tasks import evaluate_outcome as evaluate_outcome
    from tacsim.tasks import make_task as make_task
    from tacsim.tasks import register_task as register_task
    from tacsim.tasks.squeeze import Grip as Grip
else:
    __getattr__, __dir__ = public_names(__name__)
