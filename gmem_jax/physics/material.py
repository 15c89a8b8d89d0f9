"""The material of the grains, and the step between SI and simulation units.

Everything downstream works in units where the sphere radius R, Young's modulus E and density rho are one, so
that time is measured in t_c = R sqrt(rho / E), pressure in E, force in E R^2 and stiffness in E R.
"""

from dataclasses import dataclass

from gmem_jax.physics.pytree import Scalar, parameter, pytree, validate


@pytree
@dataclass(frozen=True)
class Material:
    """An elastic solid: what the spheres of all grains and their contacts are made of.

    The defaults are the paper's (Sec. II). Friction laws have stiffness and damping of their own, which do not follow.

    Attributes:
        radius: sphere radius R, in m.
        modulus: Young's modulus E, in Pa.
        density: mass density rho, in kg/m^3.
        poisson: Poisson's ratio nu.
        normal_damping: ratio gamma_n / k_n of the Hertz contact, in t_c.
        wall_rigidity: stiffness of a wall contact over that with a rigid plane; 1/2 for walls as soft as the grains.
            Through softer ones than 0.1 grains get out.

    Raises:
        ValueError: if a value is outside its physical range.
    """

    radius: Scalar = parameter(5.0e-4, "(0, inf)")
    modulus: Scalar = parameter(1.0e7, "(0, inf)")
    density: Scalar = parameter(1200.0, "(0, inf)")
    poisson: Scalar = parameter(0.49, "(-1, 0.5]")
    normal_damping: Scalar = parameter(0.23, "[0, inf)")
    wall_rigidity: Scalar = parameter(
        1.0, "[0.1, inf)", "Stiffness of walls over that of rigid ones; default 1", option=True
    )

    def __post_init__(self) -> None:
        validate(self)

    @property
    def time_unit(self) -> Scalar:
        """t_c = R sqrt(rho / E), in seconds."""
        unit: Scalar = self.radius * (self.density / self.modulus) ** 0.5
        return unit

    @property
    def plane_stiffness(self) -> Scalar:
        """Of a sphere on a rigid plane, f = k p^1.5 (Hertz; effective radius R), in E R^0.5."""
        stiffness: Scalar = (4.0 / 3.0) / ((1.0 - self.poisson) * (1.0 + self.poisson))
        return stiffness

    @property
    def wall_stiffness(self) -> Scalar:
        """k_w of a sphere on a wall, f = k_w p^1.5, in E R^0.5."""
        stiffness: Scalar = self.wall_rigidity * self.plane_stiffness
        return stiffness

    @property
    def normal_stiffness(self) -> Scalar:
        """k_n of two equal spheres, f = k_n p^1.5 (Hertz; effective radius R/2, two compliant bodies)."""
        stiffness: Scalar = self.plane_stiffness * 2.0**-1.5
        return stiffness

    @property
    def mindlin_stiffness(self) -> Scalar:
        """k_M of the Mindlin laws, df = k_M p^0.5 dsigma."""
        stiffness: Scalar = 3.0 * self.normal_stiffness * (1.0 - self.poisson) / (2.0 - self.poisson)
        return stiffness

    def pascal(self, pressure: Scalar) -> Scalar:
        """A simulation pressure (in E) in Pa."""
        return pressure * self.modulus

    def seconds(self, time: Scalar) -> Scalar:
        """A simulation time (in t_c) in s."""
        return time * self.time_unit
