"""Where the light of a sensor is calibrated, from presses of a ball: `calibrator.calibrate_light`."""
