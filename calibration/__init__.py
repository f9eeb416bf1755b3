"""Calibration of real tactile sensors for the simulator: light, lens, markers, poses, and a comparison of both.

The names below are public: ``from calibration import read_bundle, FrameNormaliser``. A module is imported at the first
access to one of its names. The paths of modules are private and may change from one version to the next.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from tacsim.lazy import public_names

if TYPE_CHECKING:
    from calibration.bundle import BadBundle as BadBundle
    from calibration.bundle import Calibration as Calibration
    from calibration.bundle import read_bundle as read_bundle
    from calibration.bundle import read_sensor_model as read_sensor_model
    from calibration.bundle import write_bundle as write_bundle
    from calibration.compare.compare import Comparison as Comparison
    from calibration.compare.compare import Pairing as Pairing
    from calibration.compare.compare import compare_frames as compare_frames
    from calibration.errors import BadFrames as BadFrames
    from calibration.errors import CalibrationError as CalibrationError
    from calibration.frame_normaliser import FrameNormaliser as FrameNormaliser
    from calibration.frame_set import Frame as Frame
    from calibration.frame_set import FrameSet as FrameSet
    from calibration.frame_set import read_frame_set as read_frame_set
    from calibration.lens.board import Board as Board
    from calibration.lens.board import find_board as find_board
    from calibration.lens.board import parse_board as parse_board
    from calibration.lens.view import GelView as GelView
    from calibration.lens.view import Lens as Lens
    from calibration.lens.view import board_pose as board_pose
    from calibration.lens.view import fit_lens as fit_lens
    from calibration.lens.view import fit_view as fit_view
    from calibration.lens.view import view_of_corners as view_of_corners
    from calibration.light.calibrator import calibrate_light as calibrate_light
    from calibration.light.fit import LightFit as LightFit
    from calibration.light.noise import measure_noise as measure_noise
    from calibration.markers.flow import MarkerFlow as MarkerFlow
    from calibration.markers.flow import find_markers as find_markers
    from calibration.normaliser import normaliser_for_calibration as normaliser_for_calibration
    from calibration.normaliser import normaliser_for_camera as normaliser_for_camera
    from calibration.normaliser import normaliser_for_pictures as normaliser_for_pictures
    from calibration.normaliser import normaliser_for_recording as normaliser_for_recording
    from calibration.normaliser import normaliser_for_simulation as normaliser_for_simulation
    from calibration.poses.ball_touch import BallTouch as BallTouch
    from calibration.poses.ball_touch import TouchFit as TouchFit
    from calibration.poses.ball_touch import fit_touches as fit_touches
    from calibration.poses.hand_eye import BoardPose as BoardPose
    from calibration.poses.hand_eye import HandEyeFit as HandEyeFit
    from calibration.poses.hand_eye import fit_hand_eye as fit_hand_eye
    from calibration.poses.latency import Latency as Latency
    from calibration.poses.latency import estimate_latency as estimate_latency
else:
    __getattr__, __dir__ = public_names(__name__)
