"""Waveforms and their integrals: the paper's table, closed forms, and curves through given samples."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gmem_jax.experiment.record import names_of, signals_to_dict
from gmem_jax.experiment.signals import (
    Bumps,
    bin_average,
    bit_width,
    part,
    sets_of,
    signals,
    six_signals,
    waveform,
    word_bits,
    words,
)
from gmem_jax.files.waveforms import signals_from_dict

SIX = six_signals()
SHEAR = jax.jit(lambda signals, u: signals.shear(u))
INTEGRAL = jax.jit(lambda signals, u: signals.integral(u))
TABLE = [
    ([0.3], [1.0]),
    ([0.7], [1.0]),
    ([0.3, 0.7], [1.0, 1.0]),
    ([0.3, 0.7], [-1.0, 1.0]),
    ([0.3, 0.7], [1.0, -1.0]),
    ([0.2, 0.5, 0.8], [0.5, -1.0, 0.5]),
]
FINE = jnp.linspace(0.0, 1.0, 40_001)
WAVE = np.random.default_rng(0).normal(size=(2, 9))
SETS = {"six signals": SIX, "samples": waveform(WAVE), "words": words(3)}


def cumulative(signals) -> np.ndarray:
    """The integral of `shear` on FINE by Simpson's rule, from 0 to every second point."""
    y = np.asarray(SHEAR(signals, FINE))
    h = float(FINE[1])
    return np.cumsum(h / 3.0 * (y[:-2:2] + 4.0 * y[1:-1:2] + y[2::2]), axis=0)


@pytest.mark.parametrize("row", range(6))
def test_each_signal_has_its_amplitudes_at_its_bump_centres_and_is_zero_between(row):
    centres, heights = TABLE[row]
    values = np.asarray(SHEAR(SIX, jnp.asarray(centres)))[:, row]
    np.testing.assert_allclose(values, heights, rtol=1e-15)
    everywhere = np.asarray(SHEAR(SIX, FINE))[:, row]
    outside = np.all(np.abs(np.asarray(FINE)[:, None] - np.array(centres)) > 0.1 + 1e-12, axis=1)
    assert np.all(everywhere[outside] == 0.0)
    assert np.abs(everywhere).max() == pytest.approx(np.abs(heights).max(), rel=1e-8)  # and peaks nowhere else


@pytest.mark.parametrize(
    ("amplitudes", "centres", "width"),
    [(np.eye(3), np.full(3, 0.5), 0.1), (np.ones(3), np.full(3, 0.5), 0.1), (np.eye(3), np.eye(3), np.full(3, 0.1))],
)
def test_bumps_of_another_shape_than_their_centres_are_refused(amplitudes, centres, width):
    with pytest.raises(ValueError, match=r"amplitudes must be \[S, b\], centres .* got"):
        Bumps(amplitudes, centres, width)


def test_a_bump_is_half_a_period_of_a_cosine():
    u = jnp.asarray([0.25, 0.3 + 0.2 / 3.0])  # a quarter and a third of the width off centre
    np.testing.assert_allclose(SHEAR(SIX, u)[:, 0], np.cos(np.pi * np.array([0.25, 1.0 / 3.0])), rtol=1e-13)


def test_signals_with_separate_bumps_are_orthogonal():
    values = np.asarray(SHEAR(SIX, FINE))
    assert np.all(values[:, 0] * values[:, 1] == 0.0)
    overlap = values.T @ values / len(FINE)
    assert abs(overlap[2, 3]) < 1e-15  # sum and difference of equal bumps
    assert abs(overlap[2, 4]) < 1e-15


@pytest.mark.parametrize("name", SETS)
def test_the_integral_is_the_integral_of_the_shear(name):
    signals = SETS[name]
    # Simpson across the kink at a bump's edge errs by its jump of slope (pi / du) times h^2 / 6 at most: 2e-9.
    np.testing.assert_allclose(INTEGRAL(signals, FINE)[2::2], cumulative(signals), atol=4e-9)


@pytest.mark.parametrize("name", SETS)
def test_the_slope_of_the_integral_is_the_shear(name):
    signals = SETS[name]
    u = jnp.asarray([0.11, 0.26, 0.333, 0.55, 0.79])
    _, slope = jax.jvp(signals.integral, (u,), (jnp.ones(5),))
    np.testing.assert_allclose(slope, SHEAR(signals, u), atol=1e-13)


@pytest.mark.parametrize("name", SETS)
def test_signals_and_integrals_start_at_zero_and_shear_ends_at_zero(name):
    signals = SETS[name]
    ends = jnp.asarray([0.0, 1.0])
    assert np.all(np.asarray(SHEAR(signals, ends)) == 0.0)
    assert np.all(np.asarray(INTEGRAL(signals, ends))[0] == 0.0)


@pytest.mark.parametrize("width", [0.2, 0.05])
def test_a_single_bump_integrates_to_two_widths_over_pi(width):
    bump = Bumps(jnp.ones((1, 1)), jnp.full((1, 1), 0.4), width)
    assert float(INTEGRAL(bump, jnp.asarray(1.0))[0]) == pytest.approx(2.0 * width / np.pi, rel=1e-14)
    assert float(INTEGRAL(bump, jnp.asarray(0.4))[0]) == pytest.approx(width / np.pi, rel=1e-14)


def test_a_bump_cut_by_the_end_of_the_range_integrates_from_zero():
    bump = Bumps(jnp.ones((1, 1)), jnp.zeros((1, 1)), 0.2)  # centred on u = 0: half of it is inside
    # The compiler may compute the two halves of the difference apart: round-off.
    assert abs(float(INTEGRAL(bump, jnp.asarray(0.0))[0])) < 1e-16
    assert float(INTEGRAL(bump, jnp.asarray(1.0))[0]) == pytest.approx(0.2 / np.pi, rel=1e-14)


def test_samples_pass_through_their_nodes():
    nodes = jnp.arange(1, 10) / 10.0
    # The place of a node is rounded to a few ulp of 10, times a slope of about 10 per unit of u.
    np.testing.assert_allclose(SHEAR(waveform(WAVE), nodes).T, WAVE, atol=1e-13)


def test_samples_reproduce_a_straight_line_between_inner_nodes():
    inner = jnp.asarray([0.31, 0.42, 0.58])  # two intervals away from the ends, where the line drops to zero
    signals = waveform(2.0 - 3.0 * np.arange(1, 10) / 10.0)
    np.testing.assert_allclose(SHEAR(signals, inner)[:, 0], 2.0 - 3.0 * np.asarray(inner), rtol=1e-12)


def test_samples_converge_to_a_smooth_waveform_at_third_order():
    def error(n: int) -> float:
        smooth = waveform(np.sin(np.pi * np.arange(1, n + 1) / (n + 1)) ** 2)
        return float(np.abs(SHEAR(smooth, FINE)[:, 0] - np.sin(np.pi * np.asarray(FINE)) ** 2).max())

    # Catmull-Rom: third order inside. sin^2 has no slope at the ends, so the one-sided slopes there do less well.
    assert np.log2(error(31) / error(63)) > 1.9


def test_samples_are_smooth_across_nodes():
    shear = waveform(WAVE).shear
    around = jnp.asarray([0.4 - 1e-9, 0.4 + 1e-9])
    _, slope = jax.jvp(shear, (around,), (jnp.ones(2),))
    np.testing.assert_allclose(slope[0], slope[1], atol=1e-5)  # curvature of order 1e3 over 2e-9


def test_one_row_of_samples_is_one_signal_and_several_are_several():
    assert waveform([1.0, 2.0, 3.0]).count == 1
    assert waveform(np.ones((4, 3))).count == 4
    assert six_signals().count == 6
    assert SHEAR(waveform(np.ones((4, 3))), jnp.zeros((5, 2))).shape == (5, 2, 4)
    assert INTEGRAL(SIX, jnp.zeros((5, 2))).shape == (5, 2, 6)


@pytest.mark.parametrize("samples", [1.0, [1.0], np.ones((2, 2, 2)), np.ones((0, 4))])
def test_samples_of_the_wrong_shape_are_refused(samples):
    with pytest.raises(ValueError, match="a waveform needs at least 2 samples"):
        waveform(samples)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_samples_that_are_not_finite_are_refused(bad):
    with pytest.raises(ValueError, match="not a finite number"):
        waveform([0.0, bad, 0.0])


def test_integer_samples_are_as_good_as_floats():
    whole, real = waveform([1, 2, -4]), waveform([1.0, 2.0, -4.0])
    np.testing.assert_allclose(INTEGRAL(whole, FINE), INTEGRAL(real, FINE), atol=1e-15)


def test_samples_can_be_differentiated():
    def value(samples):
        return waveform(samples).integral(jnp.asarray(0.62))[0]

    slope = jax.jit(jax.grad(value))(jnp.asarray(WAVE[0]))
    step = 1e-6 * np.eye(9)[4]
    central = (value(jnp.asarray(WAVE[0] + step)) - value(jnp.asarray(WAVE[0] - step))) / 2e-6
    assert float(slope[4]) == pytest.approx(float(central), rel=1e-7)  # the integral is linear in the samples


def test_bins_hold_the_average_of_the_integral_not_its_samples():
    averaged = np.asarray(bin_average(six_signals()))
    assert averaged.shape == (6, 256)
    bins = np.asarray(INTEGRAL(SIX, (jnp.arange(256 * 200) + 0.5) / (256 * 200))).reshape(256, 200, 6)
    # Midpoint rule on 16 points: (1/4096)^2 / 24 times the steepest slope of I, pi / du = 16.
    np.testing.assert_allclose(averaged, bins.mean(axis=1).T, atol=5e-8)
    middle = np.asarray(INTEGRAL(SIX, (jnp.arange(256) + 0.5) / 256)).T
    assert np.abs(averaged - middle).max() > 1e-6


def spelt(number: int, bits: int) -> list[int]:
    """The bits of a number, by the language's own formatting."""
    return [int(digit) for digit in f"{number:0{bits}b}"]


@pytest.mark.parametrize("bits", range(1, 13))
def test_there_are_two_to_the_bits_words_most_significant_bit_first(bits):
    assert words(bits).count == 2**bits
    assert word_bits(bits).tolist() == [spelt(number, bits) for number in range(2**bits)]


@pytest.mark.parametrize("bits", [1, 2, 3, 6, 9])
def test_every_bit_of_a_word_is_a_plateau_of_plus_or_minus_its_width_over_pi(bits):
    u_b = 1.0 / (bits + 4)  # two bits of padding at either end
    middles = (2.5 + np.arange(bits)) * u_b
    plateaus = np.asarray(INTEGRAL(words(bits), jnp.asarray(middles))).T
    signs = 2.0 * np.array([spelt(number, bits) for number in range(2**bits)]) - 1.0
    np.testing.assert_allclose(plateaus, signs * u_b / np.pi, rtol=1e-13)
    assert bit_width(bits) == u_b


@pytest.mark.parametrize("bits", [1, 3, 7, 12])
def test_words_begin_and_end_at_zero_and_stay_there_in_the_padding(bits):
    u_b = 1.0 / (bits + 4)
    quiet = jnp.asarray([0.0, u_b, 1.499 * u_b, 1.0 - 1.499 * u_b, 1.0 - u_b, 1.0])
    signals = words(bits)
    assert np.all(np.asarray(SHEAR(signals, quiet)) == 0.0)
    assert np.abs(INTEGRAL(signals, quiet)).max() < 1e-15  # cancelling bumps: round-off of sums of order u_b
    moving = jnp.asarray([1.501 * u_b, 1.0 - 1.501 * u_b])  # just inside the first and the last bump
    assert np.all(np.asarray(SHEAR(signals, moving)) != 0.0)


def by_hand(number: int, bits: int, u: np.ndarray) -> np.ndarray:
    """I of one word after App. A, written out bump by bump."""
    u_b, b = 1.0 / (bits + 4), spelt(number, bits)
    bumps = [(2 * u_b, b[0] - 0.5), ((2 + bits) * u_b, 0.5 - b[-1])]
    bumps += [((2 + k + 1) * u_b, b[k + 1] - b[k]) for k in range(bits - 1)]
    total = np.zeros_like(u)
    for centre, height in bumps:
        inside = np.abs(u - centre) < 0.5 * u_b
        total[inside] += height * np.cos(np.pi * (u[inside] - centre) / u_b)
    return total


@pytest.mark.parametrize(("bits", "number"), [(1, 0), (1, 1), (3, 5), (4, 6), (5, 0), (10, 0b1011001110)])
def test_a_word_is_the_sum_of_bumps_of_appendix_a(bits, number):
    u = np.linspace(0.0, 1.0, 3001)
    # The argument of the cosine is rounded to a few ulp of u / u_b, some 10.
    np.testing.assert_allclose(SHEAR(words(bits), jnp.asarray(u))[:, number], by_hand(number, bits, u), atol=1e-13)


def test_a_word_and_its_complement_are_opposite_waveforms():
    signals = words(5)
    np.testing.assert_array_equal(signals.amplitudes, -signals.amplitudes[::-1])
    np.testing.assert_array_equal(signals.centres, signals.centres[::-1])


@pytest.mark.parametrize("bits", [0, 13, -1, 2.0, "3", True])
def test_words_of_no_length_or_too_long_are_refused(bits):
    with pytest.raises(ValueError, match="a word has 1 to 12 bits"):
        words(bits)


@pytest.mark.parametrize(
    ("made", "form"),
    [(SIX, {"kind": "six"}), (words(3, 1.5, 0.75), {"kind": "words", "bits": 3, "pad": 1.5, "width": 0.75})],
)
def test_waveforms_are_written_by_what_made_them_while_they_are_that(made, form):
    assert signals_to_dict(made) == signals_to_dict(jax.tree.map(jnp.asarray, part(made, 0, made.count))) == form
    others = part(made, 0, 2), dataclasses.replace(made, width=0.1), jax.tree.map(lambda leaf: 0.5 * leaf, made)
    for other in others:
        assert set(signals_to_dict(other)) == {"kind", "amplitudes", "centres", "width"}
        assert names_of(other)[0] == "signal 1"


def test_what_made_waveforms_is_no_part_of_what_programs_are_compiled_for():
    own = Bumps(SIX.amplitudes, SIX.centres, SIX.width)
    assert own == SIX
    assert signals_to_dict(own)["kind"] == "bumps"
    seen = []
    program = jax.jit(lambda signals: seen.append(signals) or signals.shear(FINE[:3]))
    np.testing.assert_array_equal(program(own), program(SIX))
    assert len(seen) == 1


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Series:
    """Waveforms of one's own: [n, S] factors of n sines, and as many numbers that are no signals'."""

    factors: jax.Array
    shares: jax.Array

    @property
    def count(self) -> int:
        return self.factors.shape[1]

    def shear(self, u):
        waves = jnp.sin(jnp.pi * (1.0 + jnp.arange(len(self.shares))) * u[..., None])
        return (self.shares * waves) @ self.factors

    def integral(self, u):
        k = jnp.pi * (1.0 + jnp.arange(len(self.shares)))
        return (self.shares * (1.0 - jnp.cos(k * u[..., None])) / k) @ self.factors


def test_waveforms_of_one_s_own_are_told_by_a_hash_and_not_made_from_it():
    written = signals_to_dict(Series(jnp.ones((3, 3)), jnp.ones(3)))
    assert set(written) == {"kind", "sha256"}
    with pytest.raises(ValueError, match="waveforms of the class Series, which the library lacks"):
        signals_from_dict(written)


def test_a_part_of_waveforms_of_one_s_own_has_their_numbers():
    own, u = Series(jnp.arange(9.0).reshape(3, 3), jnp.asarray([1.0, 0.5, 0.2])), jnp.linspace(0.0, 1.0, 7)
    for whole in (own, six_signals(), waveform(np.ones((3, 4))), signals(xy=own, z=waveform(np.ones((3, 4))))):
        few = part(whole, 1, 3)
        assert few.count == 2
        for name, one in sets_of(whole).items():
            np.testing.assert_array_equal(sets_of(few)[name].shear(u), one.shear(u)[:, 1:3])
            np.testing.assert_array_equal(sets_of(few)[name].integral(u), one.integral(u)[:, 1:3])
