"""Calibration of the light of a sensor from presses of a ball: `calibrator.calibrate_light`."""
