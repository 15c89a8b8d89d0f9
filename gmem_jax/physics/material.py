"""The material of the grains, and the step between SI and simulation units.

Everything downstream works in units where the sphere radius R, Young's modulus E and density rho are one, so
that time is measured in t_c = R sqrt(rho / E), pressure in E, force in E R^2 and stiffness in E R.
"""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Material:
    """An elastic solid: what the spheres of all grains and their contacts are made of.

    The defaults are the paper's (Sec. II).

    Attributes:
        radius: sphere radius R, in m.
        modulus: Young's modulus E, in Pa.
        density: mass density rho, in kg/m^3.
        poisson: Poisson's ratio nu.
        normal_damping: ratio gamma_n / k_n of the Hertz contact, in t_c.
        tangential_damping: ratio gamma / k of a tangential spring, in t_c.

    Raises:
        ValueError: if a value is outside its physical range.
    """

    radius: float = 5.0e-4
    modulus: float = 1.0e7
    density: float = 1200.0
    poisson: float = 0.49
    normal_damping: float = 0.23
    tangential_damping: float = 0.069

    def __post_init__(self) -> None:
        for name in ("radius", "modulus", "density"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"Material.{name} must be positive, got {getattr(self, name)}")
        if not -1.0 < self.poisson <= 0.5:
            raise ValueError(f"Material.poisson must be in (-1, 0.5], got {self.poisson}")
        if not (self.normal_damping >= 0.0 and self.tangential_damping >= 0.0):
            raise ValueError("Material damping times must not be negative")

    @property
    def time_unit(self) -> float:
        """t_c = R sqrt(rho / E), in seconds."""
        return self.radius * math.sqrt(self.density / self.modulus)

    @property
    def wall_stiffness(self) -> float:
        """k_w of a sphere on a rigid plane, f = k_w p^1.5 (Hertz; effective radius R), in E R^0.5."""
        return (4.0 / 3.0) / (1.0 - self.poisson**2)

    @property
    def normal_stiffness(self) -> float:
        """k_n of two equal spheres, f = k_n p^1.5 (Hertz; effective radius R/2, two compliant bodies)."""
        return self.wall_stiffness / math.sqrt(8.0)

    @property
    def mindlin_stiffness(self) -> float:
        """k_M of the Mindlin laws, df = k_M p^0.5 dsigma."""
        return 3.0 * self.normal_stiffness * (1.0 - self.poisson) / (2.0 - self.poisson)

    def pascal(self, pressure: float) -> float:
        """A simulation pressure (in E) in Pa."""
        return pressure * self.modulus

    def seconds(self, time: float) -> float:
        """A simulation time (in t_c) in s."""
        return time * self.time_unit
