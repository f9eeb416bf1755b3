"""Where a picture becomes a height.

`surface_finder` does it, in three steps: changes of colour become slopes (`slope_polynomial` for a calibrated light,
`colour_table` for a simulated one), slopes become heights (`integration`), and both go onto the canonical grid.
"""
