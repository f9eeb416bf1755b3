"""What a scene refuses before anything is built from it."""

from __future__ import annotations

import math
from typing import Any

import pytest
from pydantic import ValidationError

from tacsim.models.material import BodyMaterial, GelMaterial, elastic_constants, shear_impedance
from tacsim.models.quantity import Config
from tacsim.models.rig import RigConfig, SimArmConfig
from tacsim.models.scene import Body, Box, Gel, Indenter, Mesh, Scene, Settling, Sphere
from tacsim.models.sensor import CanonicalGrid
from tacsim.models.task import RepositionConfig, SqueezeConfig


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"element_size": 1e-9}, r"1\.6e\+21 cells at element_size 1e-09 m, the limit is 5,000,000"),
        ({"gel": {"size": [1e308, 1e308, 1e308]}}, "inf cells"),
        ({"gel": {"size": [0.02, 0.02, 1e-6]}}, r"3\.2e\+09 cells at element_size 5e-07 m"),
        ({"physics": "seed", "particle_spacing": 1e-5}, r"1\.6e\+09 cells at particle_spacing 1e-05 m"),
        ({"element_size": 2.1e-3}, r"too coarse for a gel 0\.004 m thick.*at most 0\.002 m"),
    ],
)
def test_a_resolution_that_no_machine_or_no_gel_has_is_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        Scene.model_validate(values)


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
@pytest.mark.parametrize(
    ("model", "key"),
    [
        (Scene, "particle_spacing"),
        (Scene, "element_size"),
        (Mesh, "scale"),
        (SqueezeConfig, "success"),
        (SqueezeConfig, "reward_scale"),
        (RepositionConfig, "max_step"),
        (RepositionConfig, "loads"),
        (RigConfig, "period"),
        (SimArmConfig, "speed"),
        (SimArmConfig, "turn_rate"),
    ],
)
def test_what_must_be_positive_is_refused_where_it_enters(model: type[Config], key: str, value: float) -> None:
    """Spacing of particles, scale of meshes, bounds of the score, loads, longest step: nothing behind asks again."""
    with pytest.raises(ValidationError, match=key):
        model.model_validate({key: {"upper": value} if key == "loads" else value})


def test_the_coarsest_gel_has_two_layers() -> None:
    assert Scene(element_size=2e-3).effective_element_size == 2e-3


@pytest.mark.parametrize("modulus", [0.5, 1e308])
def test_a_modulus_that_no_material_has_is_refused(modulus: float) -> None:
    for material in (GelMaterial, BodyMaterial):
        with pytest.raises(ValidationError, match="youngs_modulus"):
            material(youngs_modulus=modulus)


@pytest.mark.parametrize("density", [0.0, 1e-300, 0.99, 1.01e5])
def test_a_density_that_no_material_has_is_refused(density: float) -> None:
    """A motion in real time would take for ever, and what is divided by it overflow."""
    for material in (GelMaterial, BodyMaterial):
        with pytest.raises(ValidationError, match="density"):
            material(density=density)


def test_sizes_beyond_what_touches_a_gel_are_refused() -> None:
    for size in (1e-300, 1e308):
        with pytest.raises(ValidationError, match="radius"):
            Sphere(radius=size)
        with pytest.raises(ValidationError, match="size"):
            Box(size=(1e-2, size, 1e-2))
        with pytest.raises(ValidationError, match="pitch"):
            CanonicalGrid(pitch=size)


def test_only_a_body_that_yields_can_harden() -> None:
    assert BodyMaterial(yield_stress=30e3, hardening_modulus=1e5).hardening_modulus == 1e5
    assert BodyMaterial(yield_strain=0.05, hardening_modulus=1e5).hardening > 0.0
    assert BodyMaterial(hardening_modulus=0.0).hardening == 0.0
    with pytest.raises(ValidationError, match=r"hardening_modulus 100000 Pa without a yield.*give yield_stress"):
        BodyMaterial(hardening_modulus=1e5)
    with pytest.raises(ValidationError, match="hardening_modulus"):
        BodyMaterial(yield_stress=30e3, hardening_modulus=-1.0)


@pytest.mark.parametrize("name", ["yield_stress", "yield_strain"])
def test_a_body_that_yields_at_nothing_is_refused(name: str) -> None:
    """It would be a liquid. A file's author reads what is allowed: tests/tacsim/config/test_errors.py."""
    for value in (0.0, -1e-3):
        with pytest.raises(ValidationError, match=rf"{name}\n.*greater than 0"):
            BodyMaterial.model_validate({name: value})


def test_the_hardening_modulus_is_read_with_its_unit() -> None:
    values = {"body": {"material": {"yield_stress": "30 kPa", "hardening_modulus": "0.2 MPa"}}}
    body = Scene.model_validate(values).body
    assert body is not None
    assert body.material.hardening_modulus == pytest.approx(2e5)


def test_hardening_grows_the_limit_as_the_uniaxial_yield_stress() -> None:
    """A material whose yield stress is already that after p = 0.3 has the limit to which the other one grows."""
    soft = BodyMaterial(yield_stress=30e3, hardening_modulus=1e5)
    grown = BodyMaterial(yield_stress=30e3 + 0.3 * 1e5)
    assert soft.elastic_limit + 0.3 * soft.hardening == pytest.approx(grown.elastic_limit)


def test_the_seed_scheme_refuses_a_body_that_hardens() -> None:
    body = Body(material=BodyMaterial(yield_stress=30e3, hardening_modulus=1e5))
    with pytest.raises(ValidationError, match="physics 'seed' has no hardening; use physics 'hybrid'"):
        Scene(physics="seed", body=body)


def test_gravity_is_read_with_its_unit_and_needs_a_body_that_can_fall() -> None:
    assert Scene.model_validate({"gravity": [0, 0, "-9810 mm/s^2"]}).gravity == pytest.approx((0, 0, -9.81))
    assert BodyMaterial.model_validate({"density": "1.7 g/cm^3"}) == BodyMaterial()
    with pytest.raises(ValidationError, match="physics 'seed' has no gravity; use physics 'hybrid'"):
        Scene(physics="seed", gravity=(0.0, 0.0, -9.81))
    with pytest.raises(ValidationError, match="gravity has no body to act on"):
        Scene(body=None, indenter=Indenter(), gravity=(0.0, 0.0, -9.81))
    with pytest.raises(ValidationError, match="gravity"):
        Scene(gravity=(0.0, 0.0, -1e9))


def clay(modulus: float, yield_stress: float | None = 30e3) -> Body:
    return Body(material=BodyMaterial(youngs_modulus=modulus, yield_stress=yield_stress))


def test_a_smaller_tolerance_goes_slower_within_bounds() -> None:
    speeds = [Scene(body=clay(0.5e6), settling=Settling(tolerance=t)).peak_mach for t in (1e-1, 1e-2, 3e-3, 1e-5)]
    assert speeds == pytest.approx([0.03595, 0.03595, 0.010785, 0.001], rel=2e-3)
    dough = Body(material=BodyMaterial(youngs_modulus=0.1e6, yield_stress=5e3))  # whose yield stress rules the speed
    usual, exact = (Scene(body=dough, settling=Settling(tolerance=t)).peak_mach for t in (1e-2, 2e-3))
    assert exact == pytest.approx(usual / 5)


def test_what_yields_at_a_small_strain_goes_slower() -> None:
    soft, stiff = clay(0.15e6), clay(10e6)
    assert Scene(body=soft).peak_mach == 0.0375 and Scene(body=soft, physics="seed").peak_mach == 0.03
    mu, lam = elastic_constants(stiff.material)
    yield_stress, impedance = 2 * mu * stiff.material.elastic_limit, shear_impedance(GelMaterial())
    assert Scene(body=stiff).peak_mach == pytest.approx(3.7 * yield_stress / (lam + 2 * mu + 2.5 * impedance))
    # the bulk counts: what a motion costs in stress grows with it, at the same yield
    clays = [BodyMaterial(yield_stress=30e3, poisson_ratio=nu) for nu in (0.45, 0.49, 0.499)]
    compressed = [Scene(body=Body(material=material)) for material in clays]
    assert [scene.peak_mach for scene in compressed] == pytest.approx([0.03595, 0.009871, 0.001077], rel=2e-3)
    # beyond the slowest, no speed is chosen in silence
    with pytest.raises(ValidationError, match=r"must be moved at Mach 0\.00054 .*set settling\.mach"):
        Scene(body=Body(material=BodyMaterial(youngs_modulus=1e6, yield_stress=30e3, poisson_ratio=0.499)))
    assert Scene(body=clay(1e12), settling=Settling(mach=0.002)).peak_mach == 0.002


def test_a_gel_that_gives_way_slowly_or_hardly_at_all_makes_motions_slower() -> None:
    """Nearly incompressible it goes aside with a slow shear wave; much stiffer than the body it hardly moves."""
    gels = (0.145e6, 0.48), (0.145e6, 0.499), (0.3e6, 0.48), (10e6, 0.48), (100e6, 0.48)
    materials = [GelMaterial(youngs_modulus=modulus, poisson_ratio=nu) for modulus, nu in gels]
    speeds = [Scene(body=clay(0.5e6), gel=Gel(material=material)).peak_mach for material in materials]
    assert speeds == pytest.approx([0.03595, 0.0197, 0.0284, 0.0159, 0.0159], rel=5e-3)


def test_what_flows_between_lighter_gels_flows_faster() -> None:
    press = Scene(body=None, indenter=Indenter(geometry=Sphere(radius=1e-3)))
    assert [scene.flow_mach for scene in (Scene(), press, Scene(settling=Settling(flow_mach=0.005)))] == [
        pytest.approx(0.03),
        0.02,
        0.005,
    ]


def test_where_nothing_yields_the_gels_shear_wave_sets_the_speed_unless_one_is_given() -> None:
    """A tenth of its speed, over the pressure wave's: sqrt((1 - 2 nu) / (2 - 2 nu)); the tolerance changes nothing."""
    exact, press = Settling(tolerance=1e-4), Indenter(geometry=Sphere(radius=1e-3))
    for nu, mach in ((0.3, 0.03), (0.48, 0.0196), (0.49, 0.0140)):
        gel = Gel(material=GelMaterial(poisson_ratio=nu))
        for scene in (Scene(body=clay(1e9, None), gel=gel), Scene(body=None, indenter=press, gel=gel, settling=exact)):
            assert scene.peak_mach == pytest.approx(mach, rel=5e-3)
    assert Scene(body=clay(1e9), settling=Settling(mach=0.05)).peak_mach == 0.05
