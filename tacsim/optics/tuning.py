"""Tuned constants of rendering: from a deformed gel to pictures.

Each entry: what it is, its unit, and what it was measured on where it was. Sources: docs/decisions/0010-cast-
shadows.md, docs/decisions/0019-skin.md, docs/benchmarks.md, and the tests in tests/tacsim/optics.
"""

# ink.py
MIN_EDGE_DARKNESS = 0.15  # of the blurred edge of a dot: the share of its light that is missing
MAX_DOT_RADIUS = 2.5  # of what may be a dot [radii]
DOT_BLUR = 0.35  # of the picture [radii]
MIN_RADIUS = 1.2  # of a dot that can be found [px]

# markers.py
INK_TRANSMISSION = 0.06  # fraction of the light that a dot lets through [-]

# render.py
# Lattice of the gel's texture [m]. At this pitch its slopes have the spread (0.023 for 2 um) of Gomes' white noise on
# 54 um pixels, but they belong to the gel: an image of another size shows the same texture.
TEXTURE_PITCH = 0.12e-3
MAX_SLOPE = 2.0  # largest slope in the table of light
LIGHT_TABLE_POINTS = 256  # of that table, from slope 0 to MAX_SLOPE

# surface.py
# The table is this fine or finer [m], but has no more than so many points for each lattice spacing. Height errs by 0.2
# um rms by it, 2 um on steep flanks; on a lattice of 2 mm, whose gel is far less exact, by 1 um rms, 10 um.
SURFACE_TABLE_PITCH = 0.125e-3
MAX_POINTS_PER_SPACING = 8
MAX_LAST_STEP = 1.0 / 64.0  # largest last step [table points]: half of what OpenCV's remap resolves
