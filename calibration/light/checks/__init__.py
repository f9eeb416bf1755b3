"""Checks of a calibration of light: checks of its pictures, and the verdict."""
