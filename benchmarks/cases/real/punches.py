"""Real group: flat punches of known outline and depth, in calibrated light, against real frames.

The gel is the FFT elastic layer, because elements that resolve a sharp edge would take minutes for each press. Printed
punches differ in size from their drawing, so one scale and one place are fitted for all frames of a punch; depth and
light are not fitted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter, process_time
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from benchmarks.cases.real import balls
from benchmarks.cases.real.known_depth import compare_pictures, light_of
from benchmarks.cases.real.labels import (
    BadData,
    PressLabels,
    PunchLabel,
    find,
    read_background,
    read_labels,
    read_punches,
)
from benchmarks.harness.measure import Measurement, Timing
from benchmarks.harness.runner import Case
from tacsim.interface import Float32, FloatArray, Image, Mask
from tacsim.models.material import GelMaterial

if TYPE_CHECKING:
    from calibration.light.fit import LightFit


CASE = "punch"
BOX = 512  # pixels of the periodic square on which the layer is solved
OUTLINE_SUBSAMPLING = 8  # samples per pixel along each axis, for the outline
RIM = 12  # of the mask around the outline [px]
FIT_RIM = 20  # of the mask of the fit [px]
SCALES = (0.88, 0.92, 0.96, 1.0, 1.04)
FINE_SCALE_STEP = 0.02  # from the best scale to the two fine ones
STEPS = (4.0, 2.0, 1.0, 0.5)  # of the search for the place [px]
EDGE_BLUR = 1.0  # by the gel's coating and the optics [px]


@dataclass(frozen=True, slots=True, eq=False)
class PunchFace:
    """The face of a punch that touches the gel."""

    points: FloatArray  # (n, 2) in the image's axes, from the mesh's own axis [m]
    triangles: NDArray[np.intp]  # (m, 3)

    def mask(self, shape: tuple[int, int], x: float, y: float, pitch: float, scale: float, rim: int = 0) -> Mask:
        """(H, W) pixels that are more than half covered with the axis at x, y [px], and those within `rim` pixels."""
        import cv2

        drawn = np.zeros((shape[0] * OUTLINE_SUBSAMPLING, shape[1] * OUTLINE_SUBSAMPLING), dtype=np.uint8)
        at = (self.points * scale / pitch + [x, y] + 0.5) * OUTLINE_SUBSAMPLING - 0.5
        for corners in at[self.triangles]:
            cv2.fillConvexPoly(drawn, np.rint(corners * 16).astype(np.int32), 255, shift=4)
        covered = cv2.resize(drawn, shape[::-1], interpolation=cv2.INTER_AREA) > 127
        if rim:
            covered = cv2.dilate(covered.astype(np.uint8), np.ones((2 * rim + 1, 2 * rim + 1), dtype=np.uint8)) > 0
        return np.asarray(covered)


def read_face(path: Path) -> PunchFace:
    """The highest face of an STL in millimetres. Raises BadData."""
    from tacsim.geometry.mesh_file import load_mesh

    try:
        mesh = load_mesh(path, 1e-3)
    except (OSError, ValueError) as error:
        raise BadData(str(error)) from None
    top = np.isclose(mesh.vertices[:, 2], mesh.vertices[:, 2].max(), atol=1e-6)
    triangles = mesh.faces[top[mesh.faces].all(axis=1)]
    if len(triangles) == 0:
        raise BadData(f"{path}: its highest points form no flat face")
    return PunchFace(np.asarray(mesh.vertices[:, :2] * [1.0, -1.0], dtype=np.float64), np.asarray(triangles))


class PunchRenderer:
    """Draws dents of a punch in calibrated light."""

    def __init__(self, fit: LightFit, labels: PressLabels) -> None:
        from tacsim.models.photometric import PhotometricLight, image_grid_places

        self.reference = fit.reference
        self._still = fit.reference.astype(np.float32)
        self._mean = self._still.mean(axis=(0, 1))
        assert fit.forward is not None
        self._light = PhotometricLight(fit.forward, tuple(self._mean.tolist()))
        self._places = image_grid_places(self._still.shape[1], self._still.shape[0])
        self._blur = fit.forward.blur
        self._pitch, self._thickness = labels.pixel_pitch, labels.gel_thickness[0]

    def dent(self, face: PunchFace, scale: float, depth: float) -> Float32:
        """(BOX, BOX, 3) slopes and height [widths of the picture] of the gel under the punch, with its axis at the
        centre."""
        import cv2

        from benchmarks.truth.layer import layer_contact

        material = GelMaterial()
        gap = np.where(face.mask((BOX, BOX), BOX // 2, BOX // 2, self._pitch, scale), 0.0, 1.0)
        contact = layer_contact(
            gap, depth, self._pitch, self._thickness, material.youngs_modulus, material.poisson_ratio
        )
        height = cv2.GaussianBlur(contact.displacement, (0, 0), EDGE_BLUR)
        by_y, by_x = np.gradient(height, self._pitch)
        return np.stack([by_x, by_y, height / (self._pitch * self._still.shape[1])], axis=-1).astype(np.float32)

    def __call__(self, dent: Float32, x: float, y: float) -> Image:
        """The picture with the punch's axis at x, y [px]."""
        import cv2

        rows, columns, _ = self._still.shape
        v, u = np.mgrid[:rows, :columns].astype(np.float32)
        at = [np.float32(BOX // 2) + axis - np.float32(middle) for axis, middle in ((u, x), (v, y))]
        remapped = np.asarray(cv2.remap(dent, at[0], at[1], cv2.INTER_LINEAR), dtype=np.float32)
        change, _ = self._light.change(remapped[..., :2], *self._places, np.ascontiguousarray(remapped[..., 2]))
        if self._blur > 0:
            change = np.asarray(cv2.GaussianBlur(change, (0, 0), self._blur), dtype=np.float32)
        picture: Image = np.rint(np.clip(self._still + change, 0, 255)).astype(np.uint8)
        return picture


@dataclass(frozen=True, slots=True)
class PunchPlacement:
    """Place and scale of a punch in the picture."""

    scale: float
    x: float
    y: float
    error: float  # mean |error| in the mask of the fit [grey levels]


def fit_placement(
    draw: PunchRenderer, face: PunchFace, depths: Sequence[float], frames: Sequence[Image], pitch: float
) -> PunchPlacement:
    """Fits scale and place to all frames of a punch. Raises BadData if no contact is visible."""
    from calibration.compare import metrics

    still = draw.reference.astype(np.float32)
    changes = [frame.astype(np.float32) - still for frame in frames]
    strongest = max(changes, key=lambda change: float((change**2).mean()))
    patch = metrics.circle_of_region(metrics.contact_region(strongest))
    if patch is None:
        raise BadData("no contact is visible in the frames of the punch")
    middle = face.points[np.unique(face.triangles)].mean(axis=0) / pitch
    start = (patch.x - middle[0], patch.y - middle[1])
    where = face.mask(
        frames[0].shape[:2], *start, pitch, max(SCALES), FIT_RIM
    )  # one mask, so that errors can be compared

    def tried(scale: float) -> PunchPlacement:
        dents = [draw.dent(face, scale, depth) for depth in depths]

        def error(x: float, y: float) -> float:
            drawn = zip(dents, frames, strict=True)
            return float(
                np.mean([np.abs(draw(dent, x, y).astype(np.float32) - frame)[where].mean() for dent, frame in drawn])
            )

        best = PunchPlacement(scale, *start, error(*start))
        for step in STEPS:
            better = True
            while better:
                around = [(best.x + dx * step, best.y + dy * step) for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1))]
                next_ = min((PunchPlacement(scale, x, y, error(x, y)) for x, y in around), key=lambda one: one.error)
                better = next_.error < best.error - 1e-9
                best = next_ if better else best
        return best

    best = min((tried(scale) for scale in SCALES), key=lambda one: one.error)
    return min(
        (best, tried(best.scale - FINE_SCALE_STEP), tried(best.scale + FINE_SCALE_STEP)), key=lambda one: one.error
    )


def punch(folder: Path, mesh: str, repeat: int) -> list[Measurement]:
    """A flat punch pressed to the depth of a real press, with one fitted scale. Seconds: of FFT layer and picture."""
    labels = read_labels(folder)
    fit, _, _ = balls.calibrated(folder, light_of(folder, labels))
    found = {p: both for p, both in read_punches(folder, labels).items() if both[0].stem == mesh}
    reference = _reference(folder, labels, found)
    if reference.shape != fit.reference.shape:
        raise BadData(f"{labels.name}: the frames of the punches and those of {labels.light} differ in size")
    draw = PunchRenderer(fit, labels)
    draw.reference = reference
    face = read_face(next(iter(found.values()))[0])
    order = sorted(found, key=lambda one: one.depth)
    placed = fit_placement(
        draw, face, [one.depth for one in order], [found[one][1] for one in order], labels.pixel_pitch
    )
    rows = []
    for one in order:
        wall, cpu = perf_counter(), process_time()
        image = draw(draw.dent(face, placed.scale, one.depth), placed.x, placed.y)
        timing = Timing((perf_counter() - wall,), process_time() - cpu)
        mask = face.mask(reference.shape[:2], placed.x, placed.y, labels.pixel_pitch, placed.scale, RIM)
        figures = compare_pictures(image, found[one][1], reference, mask) | {
            "depth_mm": one.depth * 1e3, "scale": placed.scale, "x_px": placed.x, "y_px": placed.y,
        }  # fmt: skip
        rows.append(
            Measurement(
                timing, figures.pop("grey"), "grey", f"the real frame within {RIM} px of the fitted outline",
                f"{mesh}, {one.depth * 1e3:g} mm deep", None, figures,
            )
        )  # fmt: skip
    return rows


def _reference(folder: Path, labels: PressLabels, found: dict[PunchLabel, tuple[Path, Image]]) -> Image:
    path = find(folder, next(iter(found)).frames)
    assert path is not None  # the frame was found before
    return read_background(path.parent, labels)[1]


def cases(folder: Path) -> tuple[Case, ...]:
    """A case for each mesh; punches without mesh, frames or light are marked as missing. Raises ConfigError."""
    labels = read_labels(folder)
    try:
        light_of(folder, labels)
        available, lacking = {both[0].stem for both in read_punches(folder, labels).values()}, ""
    except BadData as error:
        available, lacking = set(), str(error)
    names = dict.fromkeys(Path(one.mesh[0]).stem for one in labels.punches)
    return tuple(
        Case(
            "real", CASE, "layer", f"{labels.pixel_pitch * 1e3:.3g} mm a pixel", partial(punch, folder, name),
            missing=lacking
            or ("" if name in available else f"no frame or no mesh of the punch '{name}' below {folder}"),
            long=True,
        )
        for name in names
    )  # fmt: skip
