"""What gels and bodies are made of: elasticity, yield, density; and constants derived from them."""

from __future__ import annotations

import math
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from tacsim.models.quantity import Config, Density, Pressure

Modulus = Annotated[Pressure, Field(ge=1.0, le=1e12)]  # from a foam of liquid to beyond diamond [Pa]
MassDensity = Annotated[Density, Field(ge=1.0, le=1e5)]  # from an aerogel to beyond osmium [kg/m^3]
PoissonRatio = Annotated[float, Field(ge=0.0, le=0.499)]


class GelMaterial(Config):
    """Elastic gel (neo-Hookean)."""

    youngs_modulus: Modulus = 0.145e6
    poisson_ratio: PoissonRatio = 0.48
    density: MassDensity = 1000.0  # of dynamic motions only; a guess near silicone's
    source: str = ""


class BodyMaterial(Config):
    """Elastoplastic body: Hencky elasticity, von Mises yield, linear isotropic hardening.

    Give the yield as a stress or as the seed's strain k; with neither the body is elastic, and can't harden.
    """

    youngs_modulus: Modulus = 0.5e6
    poisson_ratio: PoissonRatio = 0.45
    yield_stress: Annotated[Pressure, Field(gt=0)] | None = None
    yield_norm: Literal["uniaxial", "frobenius"] = "uniaxial"
    yield_strain: Annotated[float, Field(gt=0, lt=1)] | None = None  # k = sigma_y / (2 mu), Frobenius norm
    # H: growth of the uniaxial yield stress by equivalent plastic strain [Pa]
    hardening_modulus: Annotated[Pressure, Field(ge=0, le=1e12)] = 0.0
    # Weight and dynamic motions; inertia is scaled elsewhere. Plasticine: a guess within the published 1.5 to 2 g/cm^3.
    density: MassDensity = 1700.0
    source: str = ""

    @model_validator(mode="after")
    def _require_one_yield(self) -> Self:
        if self.yield_stress is not None and self.yield_strain is not None:
            raise ValueError("give yield_stress or yield_strain, not both")
        if self.hardening_modulus > 0 and self.yield_stress is None and self.yield_strain is None:
            raise ValueError(
                f"hardening_modulus {self.hardening_modulus:g} Pa without a yield: an elastic body does not harden; "
                f"give yield_stress or yield_strain, or leave out hardening_modulus"
            )
        return self

    @property
    def elastic_limit(self) -> float:
        """Largest Frobenius norm of the deviatoric Hencky strain, k [-]; infinite for an elastic body.

        The return mapping bounds |dev tau|_F = 2 mu k; in uniaxial stress |dev tau|_F = sqrt(2/3) sigma.
        """
        if self.yield_strain is not None:
            return self.yield_strain
        if self.yield_stress is None:
            return math.inf
        mu, _ = elastic_constants(self)
        frobenius = self.yield_stress * (math.sqrt(2.0 / 3.0) if self.yield_norm == "uniaxial" else 1.0)
        return frobenius / (2.0 * mu)

    @property
    def hardening(self) -> float:
        """Growth of `elastic_limit` by equivalent plastic strain p [-]: 2 mu k = sqrt(2/3) (sigma_y + H p)."""
        mu, _ = elastic_constants(self)
        return math.sqrt(2.0 / 3.0) * self.hardening_modulus / (2.0 * mu)


def elastic_constants(material: GelMaterial | BodyMaterial) -> tuple[float, float]:
    """Lamé constants (mu, lambda) [Pa]."""
    modulus, nu = material.youngs_modulus, material.poisson_ratio
    return modulus / (2 * (1 + nu)), modulus * nu / ((1 + nu) * (1 - 2 * nu))


def shear_impedance(material: GelMaterial) -> float:
    """Stress over speed of its shear wave, over the speed of its pressure wave: sqrt(mu (lambda + 2 mu)) [Pa]."""
    mu, lam = elastic_constants(material)
    return math.sqrt(mu * (lam + 2 * mu))
