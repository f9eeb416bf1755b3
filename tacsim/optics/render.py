"""Gel surface -> RGB image: by Phong shading, the method of Gomes et al. (RA-L 2021) that the seed paper uses, or by a
calibrated polynomial or a table of height (tacsim.models.photometric) where the sensor has one.

Camera and lights stand behind the gel, on its -z side. There a surface pressed in by `height` has the unit normal

    n = (-dh/dx, -dh/dy, -1) / sqrt(1 + |grad h|^2)

and shows ``ambient + sum over lights of colour * (diffuse * n.l + specular * (r.v)^shininess)`` with the light's
direction l, the mirrored ray r = 2 (n.l) n - l and the view v = (0, 0, -1); no shadows. Light follows from the slope
alone, so pictures look it up in a table over slopes: in half the time, and half a grey level off at most. A dent is a
bump to this camera: its right flank (dh/dx < 0) faces a light on the right (+x) and takes that colour.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import Float32, Mask
from tacsim.models.photometric import (
    CastShadows,
    DarknessModel,
    PhotometricLight,
    horizon_slope,
    image_axes,
    image_grid_places,
    position_terms,
)
from tacsim.models.scene import GelSurface
from tacsim.models.sensor import BackgroundPolynomial, GelView, Lighting, SensorModel
from tacsim.optics.grid import PixelGrid, image_grid, image_strips
from tacsim.optics.ink import separate_ink, separate_skin
from tacsim.optics.markers import marker_transmission, require_dots_on_gel
from tacsim.optics.picture_file import BadPicture, open_picture, upright_rgb, upright_size
from tacsim.optics.spline import line_matrices
from tacsim.optics.surface import SurfaceTable, bilinear_lookup, block_centres, interpolate_blocks
from tacsim.optics.tuning import LIGHT_TABLE_POINTS, MAX_SLOPE, TEXTURE_PITCH

WHITE = np.float32(255.0)
MAX_PROJECTION_ERROR = 0.5  # [px] that a pixel put on the gel and back may be off


class Renderer:
    """Renders the images of one simulated sensor. Everything that is the same in all frames is computed once.

    The texture is fixed in the image: reference and contact frames share it, also under sideways motion. Dots and skin
    that the background shows are lifted off it and move with the gel. Of a model with a `view` it is the camera's own
    picture, black around the gel. The noise of the camera is added by the sensor (tacsim.optics.noise).
    Raises ValueError when markers do not fit on the gel or the background picture does not fit the image.
    """

    def __init__(self, model: SensorModel, gel_size: tuple[float, float]) -> None:
        """`gel_size`: x, y [m]."""
        min_pixels = 128 * 128  # of a picture that is worth a table
        self.model = model
        self._grid = image_grid(model.geometry)
        self._view = None if model.view is None else _view_map(model.view)
        self._markers, self._ink = model.markers, None
        self._texture = texture_gradient(self._grid, gel_size, model.texture, model.texture_seed)
        self._clipped_share = 0.0
        self._light: PhotometricLight | None = None
        self._lights: Float32 | None = None  # the table of Phong lights, once it is asked for
        self._tabulated = self._grid.rows * self._grid.columns < min_pixels  # nothing is left to tabulate
        untouched = WHITE * untouched_image(model.lighting, self._grid.shape)
        # Of the image without the lights
        calibrated = model.photometric or model.darkness
        self._unlit = untouched if calibrated else WHITE * unlit_image(model.lighting, self._grid.shape)
        if model.markers is not None and model.markers.in_background:
            radius = model.markers.radius / model.geometry.pixel_pitch
            clean, self._ink = separate_ink(np.rint(untouched).astype(np.uint8), radius)
            self._unlit = self._unlit + (clean - untouched)
            untouched, self._markers = clean.astype(np.float32), None
        elif model.markers is not None:
            require_dots_on_gel(model.markers, gel_size)
        self._mean = untouched.mean(axis=(0, 1))
        if model.skin > 0:
            bare, skin = separate_skin(untouched, model.skin, model.geometry.pixel_pitch)
            self._unlit = self._unlit + (bare - untouched)
            self._ink = skin if self._ink is None else self._ink * skin
        if model.photometric is not None:
            red, green, blue = self._mean.tolist()
            self._light = PhotometricLight(model.photometric, (red, green, blue))
            if model.texture > 0:
                places = image_grid_places(self._grid.columns, self._grid.rows)
                self._unlit = self._unlit + self._light.change(self._texture, *places)[0]

    @property
    def clipped_share(self) -> float:
        """Fraction of the last image's surface whose slope, or depth, was clipped to the calibrated range; 0 for Phong
        lights."""
        return self._clipped_share

    def __call__(self, surface: GelSurface) -> NDArray[np.uint8]:
        """(H, W, 3) RGB image of the surface. Raises what :func:`tacsim.optics.surface.sample_surface` raises."""
        import cv2

        table = SurfaceTable(surface)
        # Calibrated light is looked up at the middles of blocks of pixels, two for each cell of the table along a side:
        # its kinks lie at the table's points, and blocks as large as cells were up to 6 grey levels off next to them
        block = 1 if self._light is None or table.folded else max(1, table.points_per_cell(self._grid) // 2)
        visible = table.table_points(block_centres(self._grid, block), fine=False)
        if (
            block > 1 and not visible[1].all()
        ):  # the gel's edge is seen, and is as sharp as the camera's blur lets it be
            block, visible = 1, table.table_points(self._grid, fine=False)
        light = self._light_contribution(table, *visible, block)
        transmission = self._ink_transmission(surface, table, visible[0], block)
        del visible  # memory that is freed early is used again while it is warm
        image = np.empty((*self._grid.shape, 3), dtype=np.uint8)

        for strip in image_strips(*self._grid.shape):
            lit, unlit = light(strip), self._unlit[strip]
            if transmission is not None:
                share = transmission(strip)
                lit, unlit = lit * share, unlit * share
            # Rounds, and saturates at black and white. cv2.add is the same to the bit, but goes to IPP in blocks of
            # 1 kB, each of which asks the processor for its name: 15 ms a picture of 640 x 480 in a virtual machine.
            cv2.addWeighted(lit, 1.0, unlit, 1.0, 0.0, image[strip], dtype=cv2.CV_8U)
        return image if self._view is None else np.asarray(cv2.remap(image, *self._view, cv2.INTER_LINEAR), np.uint8)

    def _ink_transmission(
        self, surface: GelSurface, table: SurfaceTable, points: Float32, block: int
    ) -> Callable[[slice], Float32] | None:
        """Rows of an image -> (rows, W, 1 or 3) share of its light that each pixel keeps under dots and skin."""
        ink, dots = self._ink, None
        if ink is not None:
            points = interpolate_blocks(points, block, self._grid.shape)
        if self._markers is not None:
            at_rest = table.rest_coordinates(points, self._grid) if table.folded else None
            dots = marker_transmission(surface, self._markers, self.model.geometry, at_rest)[..., None]
        if ink is None:
            return None if dots is None else dots.__getitem__

        def transmitted(rows: slice) -> Float32:
            share = bilinear_lookup(ink, table.rest_coordinates(points[rows], self._grid))
            return share if dots is None else share * dots[rows]

        return transmitted

    def _light_contribution(
        self, table: SurfaceTable, points: Float32, inside: Mask, block: int
    ) -> Callable[[slice], Float32]:
        """Rows of an image -> (rows, W, 3) what light adds to the image without it; 255 is white."""
        if self._light is not None:
            return self._calibrated_light(self._light, table, points, inside, block).__getitem__
        if self.model.darkness is None:
            return self._phong_light(table, points, inside)
        # at the points of the surface's table, of which there are fewer than pixels, as for calibrated slopes
        change, self._clipped_share = darken_by_depth(self.model.darkness, table.height, table.pitch)
        return table.interpolate_at(change * self._mean, points, inside).__getitem__

    def _phong_light(self, table: SurfaceTable, points: Float32, inside: Mask) -> Callable[[slice], Float32]:
        """Rows of an image -> (rows, W, 3) light of the lamps, by the slopes of surface and texture; 255 is white."""
        import cv2

        lighting = self.model.lighting
        slopes = table.interpolate_at(table.fields[..., 1:], points, inside)
        cv2.add(slopes, self._texture, dst=slopes)
        if not self._tabulated:
            self._lights, self._tabulated = light_table(lighting), True
        lights = self._lights
        if lights is None or not max(-float(slopes.min()), float(slopes.max())) <= MAX_SLOPE:
            return lambda rows: phong_shading(slopes[rows], lighting, white=255.0)
        return lambda rows: light_at(lights, slopes[rows])

    def _calibrated_light(
        self, calibrated: PhotometricLight, table: SurfaceTable, points: Float32, inside: Mask, block: int
    ) -> Float32:
        """(H, W, 3) change of colour by the calibrated model, as its camera blurs it; 255 is white.

        Evaluated at the points of the surface's table, of which there are fewer than pixels, and linear between them,
        as between its values at `points`, the middles of blocks of `block` x `block` pixels. Of a contrast of 100 grey
        levels, with a usual blur, it is 0.05 off (rms) and at most one, under a ball; where a sharp edge is dragged, or
        slopes are clipped, up to five.
        """
        assert self.model.photometric is not None
        grid, blur, shadows = self._grid, self.model.photometric.blur, self.model.photometric.shadows
        part = table.visible_part(grid)
        place = grid.image_coordinates(*(each[part] for each in table.deformed_coordinates()))
        fields, width = table.fields[part], np.float32(grid.columns * grid.pitch)
        colours = np.zeros_like(table.fields)
        colours[part], clipped = calibrated.change(fields[..., 1:], *place, fields[..., 0] / width)
        if shadows is not None:
            colours += shadow_colours(calibrated, shadows, table, grid)
        self._clipped_share = clipped / place[0].size
        return interpolate_blocks(
            _blur_blocks(table.interpolate_at(colours, points, inside), blur, block), block, grid.shape
        )


def _blur_blocks(colours: Float32, blur: float, block: int) -> Float32:
    """Colours (rows, columns, 3) of blocks of `block` x `block` pixels, such that the picture they are spread to is
    blurred by a normal distribution of standard deviation `blur` [px]."""
    min_sampled_width = 0.3  # a wider normal distribution keeps its variance to 5 % where it is sampled
    interpolated_variance = 1.0 / 6.0  # mean of f (1 - f), the variance of linear interpolation at f between two values
    reach = 2.5  # standard deviations that a camera's blur reaches: with OpenCV's 4 it is 0.01 grey levels another
    import cv2

    # what is linear between values has the curvature of one that is blurred by this much [blocks^2]
    variance = (blur / block) ** 2 - (interpolated_variance if block > 1 else 0.0)
    if variance > min_sampled_width:
        deviation = math.sqrt(variance)
        side = 2 * math.ceil(reach * deviation) + 1
        return np.asarray(cv2.GaussianBlur(colours, (side, side), deviation), dtype=np.float32)
    if variance == 0.0:
        return colours
    # a normal distribution as narrow as this has another variance where it is sampled; below 0, it sharpens
    weights = np.array([variance / 2, 1.0 - variance, variance / 2], dtype=np.float32)
    return np.asarray(cv2.sepFilter2D(colours, -1, weights, weights), dtype=np.float32)


def _view_map(view: GelView) -> tuple[NDArray[np.int16], NDArray[np.uint16]]:
    """Where each pixel of the camera's picture lies in the metric one, in OpenCV's fixed point; far off outside it."""
    import cv2

    geometry, (rows, columns) = view.geometry, view.image_shape
    pixels = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).astype(np.float64)
    on_gel = view.on_gel(pixels)
    # a lens is known as far as the gel reaches: beyond, its inverse may lead back into the picture
    unreliable = ~(np.linalg.norm(view.project(on_gel) - pixels, axis=-1) < MAX_PROJECTION_ERROR)
    metric = on_gel / geometry.pixel_pitch + geometry.principal
    metric[unreliable] = -10.0
    metric = np.clip(metric, -10.0, max(geometry.width, geometry.height) + 10.0)
    whole, fraction = cv2.convertMaps(metric.astype(np.float32), np.empty(0, dtype=np.float32), cv2.CV_16SC2)
    return np.asarray(whole, dtype=np.int16), np.asarray(fraction, dtype=np.uint16)


def phong_shading(gradient: Float32, lighting: Lighting, white: float = 1.0) -> Float32:
    """(H, W, 3) diffuse and specular light from a surface of slopes (H, W, 2), with white at `white`. Lights in any
    order give the same bits: they are sorted before they are summed."""
    import cv2

    slope_x, slope_y = cv2.split(gradient)
    square = np.asarray(cv2.accumulateSquare(slope_y, slope_x * slope_x), dtype=np.float32)
    cosine = np.float32(1.0) / np.sqrt(square + np.float32(1.0))  # n . v
    channels = np.zeros((3, *slope_x.shape), dtype=np.float32)
    for light in sorted(lighting.lights, key=lambda each: (*each.direction, *each.colour, each.diffuse, each.specular)):
        lx, ly, lz = (c / math.hypot(*light.direction) for c in light.direction)
        lit = np.maximum(cv2.addWeighted(slope_x, -lx, slope_y, -ly, -lz) * cosine, np.float32(0.0))  # n . l
        if light.specular > 0:
            mirrored = np.maximum(2.0 * lit * cosine + np.float32(lz), np.float32(0.0))  # r . v, as l . v = -lz
            shiny = cv2.pow(mirrored, lighting.shininess)
            brightness = cv2.addWeighted(lit, light.diffuse, shiny, light.specular, 0.0)
        else:
            brightness = lit * np.float32(light.diffuse)
        for channel, colour in zip(channels, light.colour, strict=True):
            cv2.scaleAdd(brightness, white * colour, channel, dst=channel)
    return np.asarray(cv2.merge(list(channels)), dtype=np.float32)


@lru_cache(maxsize=8)
def light_table(lighting: Lighting) -> Float32 | None:
    """(n, n, 3) light at slopes from -MAX_SLOPE to MAX_SLOPE, rows by y; 255 is white. None for highlights so narrow
    that light between the points is more than `max_table_error` off."""

    max_table_error = 0.5  # largest error of the table [grey levels]; narrower highlights are computed without it

    def light(first: float, number: int) -> Float32:
        along = ((first + np.arange(number)) * (MAX_SLOPE / LIGHT_TABLE_POINTS)).astype(np.float32)
        return phong_shading(np.stack(np.meshgrid(along, along), axis=-1), lighting, white=255.0)

    table = light(-LIGHT_TABLE_POINTS, 2 * LIGHT_TABLE_POINTS + 1)
    middles = light(0.5 - LIGHT_TABLE_POINTS, 2 * LIGHT_TABLE_POINTS)
    between = (table[1:, 1:] + table[:-1, 1:] + table[1:, :-1] + table[:-1, :-1]) / 4
    if not float(np.abs(between - middles).max()) <= max_table_error:
        return None
    table.flags.writeable = False
    return table


def light_at(table: Float32, gradient: Float32) -> Float32:
    """(H, W, 3) light at slopes (H, W, 2) no steeper than MAX_SLOPE, linear in a table of :func:`light_table`."""
    return bilinear_lookup(
        table, gradient * np.float32(LIGHT_TABLE_POINTS / MAX_SLOPE) + np.float32(LIGHT_TABLE_POINTS)
    )


def unlit_image(lighting: Lighting, shape: tuple[int, int]) -> Float32:
    """(H, W, 3) the picture without the shaded lights: ambient, or background - shade(flat gel)."""
    if lighting.background is None:
        return np.full((*shape, 3), lighting.ambient, dtype=np.float32)
    if isinstance(lighting.background, str):
        background = read_background(lighting.background, shape)
    elif isinstance(lighting.background, BackgroundPolynomial):
        background = polynomial_image(lighting.background, shape)
    else:
        background = np.broadcast_to(np.array(lighting.background, dtype=np.float32), (*shape, 3))
    flat = phong_shading(np.zeros((1, 1, 2), dtype=np.float32), lighting)
    return background - flat


def untouched_image(lighting: Lighting, shape: tuple[int, int]) -> Float32:
    """(H, W, 3) the picture of the flat gel."""
    flat = phong_shading(np.zeros((1, 1, 2), dtype=np.float32), lighting)
    untouched: Float32 = np.clip(unlit_image(lighting, shape) + flat, 0.0, 1.0)
    return untouched


def polynomial_image(background: BackgroundPolynomial, shape: tuple[int, int]) -> Float32:
    """(H, W, 3) RGB, 1 is white, not limited to 0..1."""
    u, v = np.meshgrid(*image_axes(shape[1], shape[0]))
    terms = position_terms(u, v, background.degree)
    image = np.einsum("thw,tc->hwc", terms, np.array(background.weights), optimize=True)
    return np.asarray(image, dtype=np.float32)


def read_background(path: str, shape: tuple[int, int]) -> Float32:
    """(H, W, 3) RGB picture in 0..1. Raises ValueError when it cannot be read or is not H x W (before decoding it)."""
    with open_picture(Path(path), f"lighting.background: '{path}'") as picture:
        rows, columns = upright_size(picture)
        if (rows, columns) != shape:
            raise BadPicture(
                f"lighting.background: '{path}' is {columns} x {rows} px, the sensor's image is "
                f"{shape[1]} x {shape[0]}; resize it"
            )
        return upright_rgb(picture, f"lighting.background: '{path}'").astype(np.float32) / np.float32(255.0)


def texture_gradient(grid: PixelGrid, gel_size: tuple[float, float], deviation: float, seed: int) -> Float32:
    """(H, W, 2) slopes of the gel's texture: a random surface with standard deviation `deviation` [m], fixed by `seed`;
    0 outside the gel. Control values are independent normal numbers; the spline of such has 11/20 of their spread."""
    nodes_x, nodes_y = (int(np.ceil(size / TEXTURE_PITCH)) + 3 for size in gel_size)
    noise = np.random.default_rng(seed).standard_normal((nodes_y, nodes_x), dtype=np.float32)
    noise *= deviation * 20.0 / 11.0
    value_x, slope_x = line_matrices(grid.x / TEXTURE_PITCH + (nodes_x - 1) / 2, nodes_x)
    value_y, slope_y = line_matrices(grid.y / TEXTURE_PITCH + (nodes_y - 1) / 2, nodes_y)
    by_x = (slope_x @ (value_y @ noise).T).T
    by_y = (value_x @ (slope_y @ noise).T).T
    gradient = np.stack([by_x, by_y], axis=-1) / TEXTURE_PITCH
    gradient[~grid.points_on_gel(gel_size)] = 0.0
    return np.ascontiguousarray(gradient, dtype=np.float32)


def shadow_colours(light: PhotometricLight, shadows: CastShadows, table: SurfaceTable, image: PixelGrid) -> Float32:
    """(rows, columns, 3) change of colour by cast shadows at the table's points, of an image with these pixels.

    The path to a lamp is followed over the surface as if it had moved only up and down: sideways motion is small
    against the length of a shadow.
    """
    stride = 2  # every so many points of the table along each side: shadows have soft edges
    x, y = (each[::stride, ::stride] for each in table.deformed_coordinates())
    u, v = image.image_coordinates(x, y)
    width, flat = np.float32(image.columns * image.pitch), np.float32(image.rows / image.columns)
    # from places in picture widths, which start in the middle of the picture, to metres
    start_x, start_y = x[0, 0] - u[0, 0] * width, y[0, 0] - v[0, 0] * flat * width
    height = table.height

    def height_at(x: Float32, y: Float32) -> Float32:
        return table.interpolate_at_rest(height, start_x + width * x, start_y + width * y) / width

    horizons = [horizon_slope(height_at, u, v * flat, lamp) for lamp in shadows.lamps]
    rows, columns = (np.arange(n, dtype=np.float32) / stride for n in table.height.shape[:2])
    return bilinear_lookup(light.shadow_change(horizons, u, v), np.stack(np.meshgrid(columns, rows), axis=-1))


def darken_by_depth(model: DarknessModel, height: Float32, pitch: float) -> tuple[Float32, float]:
    """(H, W, 3) relative change of colour under heights (H, W) into the gel on pixels of `pitch`, in the model's unit;
    and the share of pixels that are deeper than its table."""
    own = height - np.float32(model.share) * _local_mean(height, model.reach / pitch) if model.share else height
    depths = np.array(model.depths)
    change = np.stack([np.interp(own, depths, channel) for channel in np.array(model.changes).T], axis=-1)
    return change.astype(np.float32), float(np.count_nonzero(own > depths[-1]) / own.size)


def _local_mean(height: Float32, deviation: float) -> Float32:
    """(H, W) Gaussian mean; the picture goes on as its mirror image."""
    max_blur = 6.0  # standard deviation of a Gaussian [px] beyond which it is evaluated on a coarser picture
    import cv2

    coarser = max(1, int(deviation / max_blur))
    if coarser == 1:
        return np.asarray(cv2.GaussianBlur(height, (0, 0), deviation, borderType=cv2.BORDER_REFLECT), np.float32)
    rows, columns = height.shape
    small = cv2.resize(height, (-(-columns // coarser), -(-rows // coarser)), interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), deviation / coarser, borderType=cv2.BORDER_REFLECT)
    return np.asarray(cv2.resize(small, (columns, rows), interpolation=cv2.INTER_LINEAR), np.float32)
