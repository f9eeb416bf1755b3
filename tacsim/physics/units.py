"""Kernels count in mm and MPa; everything else counts in SI units."""

MM = 1e3  # millimetres in a metre
MPA = 1e-6  # megapascals in a pascal
