"""Prior data of common sensors: the part of the picture that shows the gel, its size, its dots.

These numbers are from manufacturers and published code, not from the user's sensor. They replace a pixel pitch that was
not measured, and check one that was. `source` gives the origin of each number, and names estimates.
"""

from __future__ import annotations

from dataclasses import dataclass

from tacsim.models.sensor import Pair


@dataclass(frozen=True, slots=True)
class SensorProfile:
    """One kind of sensor."""

    title: str
    source: str  # of the numbers
    gel_size: tuple[float, float] | None = None  # x, y size of the cropped picture [m]; None: not known
    gel_thickness: float | None = None  # [m]
    markers: bool = False  # dots are printed on the gel
    native: tuple[int, int] = (640, 480)  # width, height of the camera's own pictures [px]
    crop: float = 0.0  # share of a native picture that does not show the gel, at each border
    light: str = "coloured lights from the side"
    directed: bool | None = True  # True if the light shows the direction of a slope; None: not known

    def corners(self, shape: tuple[int, int]) -> tuple[Pair, Pair, Pair, Pair] | None:
        """The gel's corners in a picture with these rows and columns: top left, top right, bottom right, bottom left
        [px]; None for a picture that is not a native one, which is assumed to be cropped."""
        rows, columns = shape
        if not self.crop or (columns, rows) != self.native:
            return None
        left, top = self.crop * columns - 0.5, self.crop * rows - 0.5
        right, bottom = columns - 1 - left, rows - 1 - top
        return ((left, top), (right, top), (right, bottom), (left, bottom))


_MINI = SensorProfile(
    title="GelSight Mini",
    source="0.0634 mm a pixel at 320 x 240 (github.com/joehjhuang/gs_sdk); a seventh cut off at each border "
    "(github.com/gelsightinc/gsrobotics); the thickness is a guess",
    gel_size=(20.3e-3, 15.2e-3),
    gel_thickness=4.25e-3,
    native=(3280, 2464),
    crop=1 / 7,
)
PROFILES = {
    "mini": _MINI,
    "mini-markers": SensorProfile(
        title="GelSight Mini with dots", source=_MINI.source, gel_size=_MINI.gel_size,
        gel_thickness=_MINI.gel_thickness, markers=True, native=_MINI.native, crop=_MINI.crop,
    ),
    "r1.5": SensorProfile(
        title="GelSight R1.5", source="0.0877 mm a pixel at 240 x 320 (github.com/isaac-sim/IsaacLab; "
        "github.com/gelsightinc/gsrobotics says 0.081 in one place, 0.0887 in another)",
        gel_size=(21.05e-3, 28.06e-3), native=(240, 320),
    ),
    "digit": SensorProfile(
        title="DIGIT", source="21.09 px/mm at 240 x 320 (github.com/Rancho-zhao/FOTS); TACTO says 12.8, with which a "
        "ball of 4.7 mm would touch wider than it is",
        gel_size=(11.4e-3, 15.2e-3), native=(240, 320),
    ),
    "9dtact": SensorProfile(
        title="9DTact", source="0.051 mm a pixel at 640 x 480 (github.com/linchangyi1/9DTact)",
        gel_size=(32.7e-3, 24.5e-3), light="white, from behind: it darkens where the gel is pressed",
        directed=False,
    ),
    "other": SensorProfile(
        title="another sensor", source="nothing is known beforehand", light="of what kind, its pictures tell",
        directed=None,
    ),
}  # fmt: skip
