"""The material of the grains, and the conversion between SI and simulation units.

Everything else works in units where the sphere radius R, Young's modulus E and density rho are one: time is in
t_c = R sqrt(rho / E), pressure in E, force in E R^2 and stiffness in E R.
"""

from dataclasses import dataclass

from gmem_jax.physics.pytree import Scalar, parameter, pytree, validate


@pytree
@dataclass(frozen=True)
class Material:
    """The elastic solid of all spheres, which sets units and normal contact forces.

    The defaults are the paper's (Sec. II). The stiffness and damping of friction laws do not follow from it: they are
    parameters of the law.

    Attributes:
        radius: sphere radius R, in m.
        modulus: Young's modulus E, in Pa.
        density: mass density rho, in kg/m^3.
        poisson: Poisson's ratio nu.
        normal_damping: ratio gamma_n / k_n of the Hertz contact, in t_c.
        wall_rigidity: stiffness of a contact with a wall over that with a rigid plane, at least 0.1 (grains pass softer
            walls); 1/2 for walls as soft as the grains.

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
        """Stiffness k of a sphere on a rigid plane, f = k p^1.5 (Hertz; effective radius R), in E R^0.5."""
        stiffness: Scalar = (4.0 / 3.0) / ((1.0 - self.poisson) * (1.0 + self.poisson))
        return stiffness

    @property
    def wall_stiffness(self) -> Scalar:
        """Stiffness k_w of a sphere on a wall, f = k_w p^1.5, in E R^0.5."""
        stiffness: Scalar = self.wall_rigidity * self.plane_stiffness
        return stiffness

    @property
    def normal_stiffness(self) -> Scalar:
        """Stiffness k_n of two spheres of radius R, f = k_n p^1.5 (Hertz; both compliant), in E R^0.5."""
        stiffness: Scalar = self.plane_stiffness * 2.0**-1.5
        return stiffness

    @property
    def mindlin_stiffness(self) -> Scalar:
        """Tangential stiffness k_M of the Mindlin laws, df = k_M p^0.5 dsigma, in E R^0.5."""
        stiffness: Scalar = 3.0 * self.normal_stiffness * (1.0 - self.poisson) / (2.0 - self.poisson)
        return stiffness

    def pascal(self, pressure: Scalar) -> Scalar:
        """A pressure in E, converted to Pa."""
        return pressure * self.modulus

    def seconds(self, time: Scalar) -> Scalar:
        """A time in t_c, converted to s."""
        return time * self.time_unit
