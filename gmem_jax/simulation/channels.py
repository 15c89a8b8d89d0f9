"""Channels: the modes of strain of the box that can carry a waveform, and the conjugate stresses."""

from typing import Any, NamedTuple


class Channel(NamedTuple):
    """A mode of strain and the stress difference conjugate to it.

    Attributes:
        mode: strain of x, y, z for a shear of 1.
        words: what it is.
    """

    mode: tuple[float, float, float]
    words: str

    def stress(self, pressure: Any) -> Any:
        """-2 sum_i mode_i p_i of wall pressures [..., 3, B], in E: [..., B]. For "xy" it is p_x - p_y."""
        terms = [-2.0 * part * pressure[..., axis, :] for axis, part in enumerate(self.mode) if part]
        total = terms[0]
        for term in terms[1:]:
            total = total + term
        return total


CHANNELS = {
    "xy": Channel((-0.5, 0.5, 0.0), "pure shear of x against y, as in the paper"),
    "z": Channel((-0.25, -0.25, 0.5), "pure shear of z against x and y"),
    "xz": Channel((-0.5, 0.0, 0.5), "pure shear of x against z"),
    "yz": Channel((0.0, -0.5, 0.5), "pure shear of y against z"),
    "compression": Channel((-0.5, -0.5, 0.0), "areal strain of x and y together; it changes the volume"),
}
"""Channels by name. "xy" and "z" are independent: neither does work on the other's stress in an isotropic pack."""
