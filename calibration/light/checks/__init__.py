"""Whether a calibration of light can be trusted: checks of its pictures, and the verdict."""
