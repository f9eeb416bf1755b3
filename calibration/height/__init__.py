"""Conversion of a picture to a height.

`surface_finder` has three steps: changes of colour become slopes (`slope_polynomial` for a calibrated light,
`colour_table` for a simulated one), slopes become heights (`integration`), and both are sampled on the canonical grid.
"""
