"""Press group, slides: an indenter pressed on one gel slides over it, against Coulomb's law and slow motions."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.cases.press import percent, press, press_scene
from benchmarks.harness.measure import Measurement, Timing, timed
from benchmarks.harness.runner import Case
from benchmarks.truth.limit import RADIUS
from tacsim.interface import FloatArray, Pose
from tacsim.models.scene import Box, Cylinder, Indenter, Preset, Scene, Sphere
from tacsim.physics.move import MoveStats

if TYPE_CHECKING:
    from tacsim.physics.worlds.press import PressWorld


SLIDE, SLIDES = 0.5e-3, 20  # length of one slide of a plate [m], and maximum number of slides
SLIDE_SLOW = {"draft": 0.001, "standard": 0.002}  # Mach number at which speed has no influence
STAYS = 1e-3  # relative change of the force ratio in one slide


def sliding_force(element: float, repeat: int) -> list[Measurement]:
    """A plate wider than the gel slides over it until the ratio of forces is constant; it then equals the coefficient.

    There is no edge in the contact. First the gel shears, then its parts slip one after the other.
    """
    friction, depth = 0.3, 0.3e-3
    scene = press_scene(Box(size=(50e-3, 30e-3, 4e-3)), element, friction=friction, tolerance=1e-3)

    def slide() -> tuple[PressWorld, list[float], int]:
        world, _ = press(scene, depth)
        ratios, substeps = [0.0], 0
        while len(ratios) <= SLIDES:
            pose = world.pose("indenter")
            substeps += world.move({"indenter": Pose(pose.position + [SLIDE, 0, 0], pose.quaternion)}).substeps
            force = world.wrench("lower")
            ratios.append(abs(float(force[0] / force[2])))
            if abs(ratios[-1] - ratios[-2]) < STAYS * ratios[-1]:
                break
        return world, ratios, substeps

    timing, (world, ratios, substeps) = timed(slide, repeat)
    distance = (len(ratios) - 1) * SLIDE
    figures = {"ratio": ratios[-1], "normal_n": abs(float(world.wrench("lower")[2])), "way_mm": distance * 1e3}
    note = "" if len(ratios) <= SLIDES else f"the ratio still changes after {distance * 1e3:g} mm"
    return [
        Measurement(timing, percent(ratios[-1], friction), "%", "Coulomb's law", "coefficient 0.3", substeps, figures,
                    note)
    ]  # fmt: skip


def slid_ball(preset: str, repeat: int) -> list[Measurement]:
    """A ball R 4 mm, 0.5 mm deep in the shipped gel, slid by 0.5 mm, so that a part of the contact still sticks: drag
    over normal force."""
    settled = {"mach": SLIDE_SLOW[preset], "tolerance": 1e-3, "max_substeps": 500}
    rows = []
    for friction in (0.3, 0.6, 1.0, 1.5):
        ball = Indenter(geometry=Sphere(radius=RADIUS), friction=friction)
        timing, (found, stats) = timed(partial(_drag_after_slide, preset, ball, 0.5e-3, SLIDE), 1, warm=lambda: None)
        truth, _ = _drag_after_slide(preset, ball, 0.5e-3, SLIDE, **settled)
        what = f"the same mesh at Mach {SLIDE_SLOW[preset]:g}"
        rows.append(_drag_row(timing, found, stats, truth, what, f"0.5 mm, friction {friction:g}"))
    return rows


def slid_edges(preset: Preset, repeat: int) -> list[Measurement]:
    """A cylinder R 2 mm and a box of 4 mm, 0.3 mm deep, slid by 2 mm: sharp, and as round as the mesh resolves."""
    settled = {"mach": SLIDE_SLOW[preset], "tolerance": 1e-3, "max_substeps": 500}
    rows = []
    for shape in (Cylinder(radius=2e-3, height=4e-3), Box(size=(4e-3, 4e-3, 4e-3))):
        for radius, friction in ((r, mu) for r in (0.0, None) for mu in (0.3, 0.6, 1.0, 1.5)):
            edged = Indenter(geometry=shape, friction=friction, edge_radius=radius)
            timing, (found, stats) = timed(
                partial(_drag_after_slide, preset, edged, 0.3e-3, 2e-3), 1, warm=lambda: None
            )
            truth, _ = _drag_after_slide(preset, edged, 0.3e-3, 2e-3, **settled)
            what = f"the same mesh at Mach {SLIDE_SLOW[preset]:g}"
            variant = f"{'round' if radius is None else 'sharp'} {shape.shape}, friction {friction:g}"
            rows.append(_drag_row(timing, found, stats, truth, what, variant))
    return rows


def slid_in(preset: str, repeat: int) -> list[Measurement]:
    """Indenters pressed in one oblique motion from above the gel: drag over normal force."""
    settled = {"mach": SLIDE_SLOW[preset], "tolerance": 1e-3, "max_substeps": 500}
    rows = []
    for shape, friction, displacement in (
        (Sphere(radius=6e-3), 0.8, (0.6e-3, 0.0, -0.3e-3)),
        (Sphere(radius=3e-3), 1.5, (1.5e-3, 0.0, -0.8e-3)),
        (Cylinder(radius=2.5e-3, height=5e-3), 0.6, (1e-3, 0.0, -0.4e-3)),
        (Box(size=(4e-3, 4e-3, 4e-3)), 0.8, (1e-3, 1e-3, -0.5e-3)),
    ):
        indenter = Indenter(geometry=shape, friction=friction)
        timing, (found, stats) = timed(
            partial(_drag_after_oblique_press, preset, indenter, displacement), 1, warm=lambda: None
        )
        truth, _ = _drag_after_oblique_press(preset, indenter, displacement, **settled)
        what = f"the same mesh at Mach {SLIDE_SLOW[preset]:g}"
        rows.append(_drag_row(timing, found, stats, truth, what, f"{shape.shape}, friction {friction:g}"))
    return rows


def slid_turned(preset: str, repeat: int) -> list[Measurement]:
    """Slid by 1.3 mm, 0.5 mm deep, then by 0.7 mm at right angles: difference of the drag vector from slow slides."""
    settled = {"mach": SLIDE_SLOW[preset], "tolerance": 1e-3, "max_substeps": 500}
    rows = []
    for shape, friction in (
        (Sphere(radius=5e-3), 0.4),
        (Sphere(radius=RADIUS), 1.0),
        (Cylinder(radius=2.5e-3, height=5e-3), 0.5),
        (Box(size=(6e-3, 3.2e-3, 4e-3)), 0.4),
    ):
        indenter = Indenter(geometry=shape, friction=friction)
        timing, (found, stats) = timed(partial(_drag_after_turn, preset, indenter), 1, warm=lambda: None)
        truth, _ = _drag_after_turn(preset, indenter, **settled)
        off = np.linalg.norm(found - truth) / np.linalg.norm(truth)
        note = "" if stats.settled else "not settled"
        figures = {"x": float(found[0]), "y": float(found[1]), "true_x": float(truth[0]), "true_y": float(truth[1])}
        rows.append(
            Measurement(
                timing, 100.0 * float(off), "% of the drag", f"the same mesh at Mach {SLIDE_SLOW[preset]:g}",
                f"{shape.shape}, friction {friction:g}", stats.substeps, figures, note,
            )
        )  # fmt: skip
    return rows


def _drag_after_turn(preset: str, indenter: Indenter, **settling: float) -> tuple[FloatArray, MoveStats]:
    """Drag along x and y over normal force after both legs."""
    scene = {"body": None, "preset": preset, "indenter": indenter, "settling": settling}
    world, _ = press(Scene.model_validate(scene), 0.5e-3)
    for displacement in ([0.0, 1.3e-3, 0.0], [0.7e-3, 0.0, 0.0]):
        pose = world.pose("indenter")
        stats = world.move({"indenter": Pose(pose.position + displacement, pose.quaternion)})
    force = world.wrench("lower")
    return force[:2] / -force[2], stats


def _drag_after_oblique_press(
    preset: str, indenter: Indenter, displacement: tuple[float, float, float], **settling: float
) -> tuple[float, MoveStats]:
    """Drag over normal force after one motion by `displacement` [m] from first contact."""
    from tacsim.physics.worlds.press import PressWorld
    from tacsim.physics.worlds.tuning import INITIAL_GAP

    scene = {"body": None, "preset": preset, "indenter": indenter, "settling": settling}
    world = PressWorld(Scene.model_validate(scene))
    pose = world.pose("indenter")
    target = pose.position + displacement - [0.0, 0.0, INITIAL_GAP]
    stats = world.move({"indenter": Pose(target, pose.quaternion)})
    force = world.wrench("lower")
    return float(np.hypot(force[0], force[1]) / -force[2]), stats


def _drag_after_slide(
    preset: str, indenter: Indenter, deep: float, length: float, **settling: float
) -> tuple[float, MoveStats]:
    """Drag over normal force after a slide of `length`, `deep` in the gel [m]."""
    scene = Scene.model_validate(
        {
            "body": None,
            "preset": preset,
            "indenter": indenter,
            "settling": settling,
        }
    )
    world, _ = press(scene, deep)
    pose = world.pose("indenter")
    stats = world.move({"indenter": Pose(pose.position + [length, 0, 0], pose.quaternion)})
    force = world.wrench("lower")
    return float(force[0] / -force[2]), stats


def _drag_row(timing: Timing, found: float, stats: MoveStats, truth: float, what: str, variant: str) -> Measurement:
    figures, note = {"ratio": found, "truth": truth}, "" if stats.settled else "not settled"
    return Measurement(timing, percent(found, truth), "% of the drag", what, variant, stats.substeps, figures, note)


CASES = (
    Case("press", "sliding_force", "tacsim", "h 1 mm", partial(sliding_force, 1e-3)),
    *(Case("press", "slid_ball", "tacsim", preset, partial(slid_ball, preset)) for preset in ("draft", "standard")),
    *(Case("press", "slid_in", "tacsim", preset, partial(slid_in, preset)) for preset in ("draft", "standard")),
    *(Case("press", "slid_turned", "tacsim", preset, partial(slid_turned, preset)) for preset in ("draft", "standard")),
    Case("press", "slid_edges", "tacsim", "draft", partial(slid_edges, "draft")),
    Case("press", "slid_edges", "tacsim", "standard", partial(slid_edges, "standard"), long=True),
)  # fmt: skip
