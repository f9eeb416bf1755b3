"""Bodies led to and fro."""

import numpy as np
import pytest

from tacsim.interface import Pose
from tacsim.models.scene import Body, BodyMaterial, Box, Cylinder, Scene, lame
from tacsim.physics.failure.diagnosis import particle_volumes
from tacsim.physics.worlds.hybrid import HybridWorld

CUBE = Body(geometry=Box(size=(6e-3, 6e-3, 5e-3)), material=BodyMaterial(yield_stress=30e3))


def shifted(world: HybridWorld, by: dict[str, np.ndarray]) -> dict[str, Pose]:
    return {name: Pose(world.pose(name).position + d, world.pose(name).quaternion) for name, d in by.items()}


@pytest.mark.deep
@pytest.mark.parametrize("along", [(0.0, 0.0, -0.05e-3), (0.05e-3, 0.0, 0.0)], ids=["squeezed", "sheared"])
def test_flowing_to_and_fro_writes_nothing_into_the_body(along: tuple[float, float, float]) -> None:
    """Shakedown: once the first cycles have done what they do, force and elastic volume stay. With the grid's stencils
    at the particles' places of the moment every cycle left a strain of its own: force -2.6 % in these 60 cycles,
    squeezed or sheared, and the largest volume ratio grew by 0.013 and 0.005."""
    world = HybridWorld(Scene(body=CUBE))
    closing = np.array([0.0, 0.0, 0.8e-3])
    world.move(shifted(world, {"lower": closing, "upper": -closing}))

    def cycle(count: int) -> tuple[float, np.ndarray]:
        for _ in range(count):
            for step in [np.array(along)] * 3 + [-np.array(along)] * 3:
                world.move(shifted(world, {"upper": step, "lower": -step}), flow=True)
        volumes = particle_volumes(world.snapshot())
        assert volumes is not None
        return -world.wrench("lower")[2], volumes

    early, before = cycle(20)
    late, after = cycle(60)
    assert late == pytest.approx(early, rel=0.004)
    assert [after.min(), after.max()] == pytest.approx([before.min(), before.max()], abs=0.002)
    assert after.min() > 0.96 and after.max() < 1.02


def test_a_body_under_more_tension_than_it_can_bear_is_told() -> None:
    """Nothing pulls at a squeezed body: volume ratios far above 1 are strains that no node of the grid feels, as here,
    where neighbours differ in turn."""
    world = HybridWorld(Scene(body=CUBE))
    lattice = np.round(world.snapshot()["position"] / (world.scene.spacing * 1e3) - 0.5).astype(int)
    sign = 1 - 2 * (lattice.sum(axis=1) % 2)
    closing = np.array([0.0, 0.0, 0.6e-3])
    stats = world.move(shifted(world, {"lower": closing, "upper": -closing}))
    state = world.snapshot()
    volumes = particle_volumes(state)
    assert volumes is not None
    assert (stats.smallest_volume, stats.largest_volume) == pytest.approx((volumes.min(), volumes.max()), rel=1e-6)
    assert 0.96 < stats.smallest_volume < stats.largest_volume < 1.02 and stats.guard_hits == 0
    mu, lam = lame(CUBE.material)
    for tension, told in ((1.0, False), (6.0, True)):  # yield stresses (Frobenius norm)
        grown = tension * 2 * mu * CUBE.material.elastic_limit / (lam + 2 * mu / 3) * sign
        strain = state["strain"].copy()
        strain[:, :3] += (1 + strain[:, :3]) * (np.exp(2 / 3 * grown) - 1)[:, None]
        strain[:, 3:] *= np.exp(2 / 3 * grown)[:, None]
        world.restore({**state, "strain": strain})
        assert (world.move({}).guard_hits > 0) == told


@pytest.mark.deep
@pytest.mark.xfail(strict=True, reason="gel and body lag on the way there, and the body yields to it: 1.8 % are lost")
def test_the_first_settled_cycles_take_nothing() -> None:
    """Axisymmetric finite elements (quadratic, multiplicative Hencky plasticity, implicit, h 0.5 mm) of this cylinder
    between discs of gel, 2.0 to 2.3 mm and back: 2.934, 2.933, 2.933 N."""
    world = HybridWorld(Scene(body=CUBE.model_copy(update={"geometry": Cylinder(radius=5e-3, height=10e-3)})))
    lower, upper = (world.pose(name) for name in world.sensors)

    def close(by: float) -> float:
        way = np.array([0.0, 0.0, by / 2 + 0.1e-3])
        world.move({"lower": Pose(way), "upper": Pose(upper.position - way, upper.quaternion)})
        return -world.wrench("lower")[2]

    assert not lower.position.any()
    close(0.1e-3)
    forces = [close(by) for by in [2.0e-3, 2.3e-3] * 12][1::2]
    assert forces[0] == pytest.approx(2.934, rel=0.03)
    assert forces[-1] == pytest.approx(forces[0], rel=0.01)
