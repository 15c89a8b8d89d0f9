"""Tests of the paper's claims: a verdict on each, with numbers."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.experiment import analysis
from gmem_jax.experiment.analysis import compare, recalled, remembered_after, spread
from gmem_jax.experiment.experiment import Experiment
from gmem_jax.experiment.pack import Pack
from gmem_jax.experiment.recall import Recall
from gmem_jax.experiment.run import apply_waveforms, runner_of
from gmem_jax.experiment.signals import six_signals
from gmem_jax.physics.census import overlaps
from gmem_jax.physics.contact.frictionless import Frictionless
from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.numbers import plural
from gmem_jax.physics.state import Status, combined_status, explain
from gmem_jax.reproduce.figures import Values, crossed
from gmem_jax.show.tables import decimal
from gmem_jax.simulation.stage import BINS

STORES = (0.5, 2.0, 8.0)  # t0
STANDARD_STORE = 2.0
AMPLITUDES = (3e-4, 1e-3, 3e-3)
VARIED = ("gamma0", "store", "background", "shear", "hold_drag")
CHANCE = 0.05  # largest probability that packs of two kinds are in such an order by chance
LITTLE = 0.1  # part of the recall below which a claim that nothing is left holds


UNTOLD = Status.NOT_QUASI_STATIC | Status.UNLOADED  # runs with these bits are no evidence for or against a claim


class Verdict(NamedTuple):
    """The test of a claim.

    Attributes:
        claim: the claim, as a sentence.
        holds: whether it holds here; None if that cannot be told from these runs.
        numbers: the measured numbers, in a line.
        values: the measured numbers by name.
        status: bits of `Status` of its runs.
        why: why it cannot be told; "" if it can.
    """

    claim: str
    holds: bool | None
    numbers: str
    values: dict[str, Any]
    status: int = 0
    why: str = ""


def stress_is_minus_j(recall: Recall) -> Verdict:
    """p_xy at u = 1 is -C J(1): the pack keeps the integral of the shear that was applied."""
    p_xy = recalled(jnp.asarray(recall.stages[recall.protocol.reads[0]].pressure))
    kept = np.asarray(p_xy[1:, -1] - p_xy[0, -1])  # u ascends: the readout begins with the last
    whole = np.asarray(recall.J)[:, -1]
    slope = float(whole @ kept / (whole @ whole))
    left = float(np.sqrt(np.sum((kept - slope * whole) ** 2) / np.sum(kept**2)))
    return Verdict(
        "p_xy at u = 1 is -C J(1)",
        slope < 0.0 and left < 0.5,
        f"C = {-slope:.2e} E; without it {left:.0%} of the stresses are left (root mean square)",
        {"C": -slope, "left": left},
    )


def speeds_decay(free: Recall, t0: float) -> Verdict:
    """In storage, without any drag, the largest grain speed decays exponentially."""
    speed = np.asarray(free.stages[free.protocol.before_read].largest_speed).max(axis=-1)
    time = (np.arange(len(speed)) + 0.5) * t0 / BINS
    rate, start = np.polyfit(time, np.log(speed), 1)
    scatter = float(np.exp(np.std(np.log(speed) - rate * time - start)))
    falls = float(speed[0] / speed[-1])
    return Verdict(
        "in storage the largest grain speed decays exponentially",
        bool(rate < 0.0 and falls > 10.0),
        f"by e in {-1.0 / rate:.0f} t_c, {falls:.0f} times in all; scatter about it a factor {scatter:.2f}",
        {"decay_time": -1.0 / rate, "falls": falls, "scatter": scatter},
    )


def storage_costs_nothing(recalls: Mapping[float, Recall]) -> Verdict:
    """F does not depend on how long the waveform is stored."""
    found = {store: float(recall.windowed_fidelity) for store, recall in sorted(recalls.items())}
    values = [*found.values()]
    wide = float(np.ptp(values))
    said = ", ".join(f"{fidelity:.3f} after {store:g} t0" for store, fidelity in found.items())
    holds = bool(np.min(values) > LITTLE and wide < 0.02)  # where nothing is remembered, nothing is kept either
    return Verdict("F does not depend on the storage", holds, f"F = {said}", {"F": found, "spread": wide})


def reading_erases(recall: Recall, scale: float) -> Verdict:
    """The first readout erases the memory: the second is uncorrelated with J."""
    first, second = (recalled(jnp.asarray(recall.stages[name].pressure)) for name in recall.protocol.reads)
    gain = float(compare(analysis.subtract("sub0", first), recall.J, scale).gain)
    correlation, left = (spread(values) for values in remembered_after(second, recall.J, scale))
    return Verdict(
        "the first readout erases the memory",
        abs(left[0]) < LITTLE * gain,
        f"gain of the second {decimal(left[0], left[2], 4)} beside {gain:.3f}; "
        f"correlation with J {decimal(correlation[0], correlation[2], 2)} (mean and SE over signals)",
        {"gain": gain, "second_gain": left[0], "correlation": correlation[0]},
    )


def order_matters(standard: Recall, before: Recall, scale: float) -> Verdict:
    """A shear pulse before the compression leaves no waveform to be read.

    It leaves an offset, since it moves some grains for good. The offset is about as large at every u, and the same for
    one bump early, one late or two (docs/decisions/experiment.md). Most J have one sign, so that an offset alone has a
    gain. The verdict is therefore on p_sig and J less their means over u.
    """
    ratio = float(np.sqrt(np.sum(np.asarray(before.p_sig) ** 2) / np.sum(np.asarray(standard.p_sig) ** 2)))
    waved, wave = (float(compare(_less_mean(one.p_sig), _less_mean(one.J), scale).gain) for one in (before, standard))
    gain, fidelity = float(before.windowed_gain), float(before.windowed_fidelity)
    return Verdict(
        "shear before the compression leaves no waveform",
        abs(waved) < LITTLE * abs(wave),
        f"less its mean over u, what is left has G = {waved:.3f} beside {wave:.3f}; with it G = {gain:.3f}, "
        f"F = {fidelity:.3f} beside {float(standard.windowed_gain):.3f} and {float(standard.windowed_fidelity):.3f}; "
        f"p_sig {ratio:.0%} as large",
        {"G": gain, "F": fidelity, "size": ratio, "G_less_mean": waved, "standard_G_less_mean": wave},
    )


def _less_mean(rows: jax.Array) -> jax.Array:
    return rows - jnp.mean(rows, axis=-1, keepdims=True)


def proportional(recalls: dict[float, Recall]) -> Verdict:
    """p_sig is proportional to gamma0 while gamma0 << delta0: G does not depend on it."""
    gains = {gamma0: float(recall.windowed_gain) for gamma0, recall in recalls.items()}
    lowest, highest = (float(end([*gains.values()])) for end in (np.min, np.max))
    wide = highest / lowest - 1.0 if lowest > 0.0 else math.inf
    said = ", ".join(f"{gain:.3f} at {gamma0:g}" for gamma0, gain in gains.items())
    return Verdict("p_sig is proportional to gamma0", wide < 0.1, f"G = {said}", {"G": gains, "spread": wide})


def rearrangement(pack: Pack, friction: Any, t0: float) -> float:
    """Root mean square displacement of the grains after one cycle without shear, in R."""
    experiment = Experiment(pack, six_signals(), friction, t0=t0)
    on = runner_of(experiment)
    before = on.state
    common, _ = experiment.phases
    on.run_stages(*common[:4])
    moved = np.asarray(on.state.grains.position - before.grains.position)[..., 0]
    return float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))


def rearranges(tetra: Sequence[Pack], spheres: Sequence[Pack], t0: float) -> Verdict:
    """Tetra grains rearrange less than spheres over a cycle, and grains without friction most.

    A few packs move much further than others of their kind, so that the packs are compared by rank: the claim holds, or
    its opposite does, if chance alone would order them so in one of twenty cases at most (Mann-Whitney).
    """
    from scipy.stats import mannwhitneyu

    packs = {"tetra": (tetra, Hooke()), "sphere": (spheres, Hooke()), "tetra without friction": (tetra, Frictionless())}
    found = {name: [rearrangement(pack, law, t0) for pack in some] for name, (some, law) in packs.items()}
    own, *others = found.values()
    less, more = (
        [mannwhitneyu(own, other, alternative=way, method="exact").pvalue <= CHANCE for other in others]
        for way in ("less", "greater")
    )
    medians = {name: float(np.median(values)) for name, values in found.items()}
    said = ", ".join(f"{median:.1e} R ({name})" for name, median in medians.items())
    known = all(less) or any(more)
    return Verdict(
        "tetra grains rearrange less than spheres, and less than without friction",
        all(less) if known else None,
        f"displacement that a cycle leaves: {said} (median of {plural(len(tetra), 'pack')})",
        medians,
        why="" if known else "packs of one kind differ as much",
    )


def forces_tell_nothing(experiment: Experiment) -> Verdict:
    """The distribution of contact forces at u = 1 does not show whether a signal was stored.

    The test is Kolmogorov's distance between the distributions with and without a signal. It is compared with the
    distance between two random halves of the contacts of one pack, which is due to chance.
    """
    from scipy.stats import ks_2samp

    on = runner_of(experiment)
    common, own = experiment.phases
    on.run_stages(*common)
    apply_waveforms(on, experiment)
    on.run_stages(own[0])
    # Hertz' forces are proportional to overlaps to the power 3/2.
    forces = np.maximum(np.asarray(overlaps(on.simulation.system, on.state)), 0.0) ** 1.5
    samples = [np.sort(column[column > 0.0]) for column in forces.T]
    scaled = [sample / sample.mean() for sample in samples]
    distance = max(float(ks_2samp(scaled[0], other, method="asymp").statistic) for other in scaled[1:])
    halves = np.random.default_rng(0).permutation(scaled[0])
    chance = float(ks_2samp(halves[::2], halves[1::2], method="asymp").statistic)
    return Verdict(
        "contact-force distributions carry no trace of the signal",
        distance < chance,
        f"largest distance to that without signal {distance:.4f}, between halves of one {chance:.4f} (Kolmogorov)",
        {"distance": distance, "chance": chance},
    )


def claim_points(packs: Sequence[Values]) -> list[Values]:
    """The points that the claims need, on each of some packs."""
    amplitudes: list[Values] = [{"gamma0": gamma0} for gamma0 in AMPLITUDES]
    stores: list[Values] = [{"store": store} for store in STORES if store != STANDARD_STORE]
    more: list[Values] = [{"background": "sub2"}, {"shear": "before"}, {"store": max(STORES), "hold_drag": 0.0}]
    return crossed(packs, [*amplitudes, *stores, *more])


def verdicts(
    tetra: Sequence[Pack], spheres: Sequence[Pack], t0: float, runs: Sequence[tuple[Values, Recall]]
) -> list[Verdict]:
    """Every claim on one pack, but that on rearrangement on all.

    Args:
        tetra: packs of tetra grains; the first is that of the runs.
        spheres: packs of spheres.
        t0: duration of one compression, in t_c.
        runs: values and recalls of `claim_points` on the first pack.
    """
    pack = tetra[0]

    def having(**wanted: Any) -> Recall:
        own = ({name: values[name] for name in VARIED if name in values} for values, _ in runs)
        return next(recall for values, (_, recall) in zip(own, runs, strict=True) if values == wanted)

    amplitudes = {gamma0: having(gamma0=gamma0) for gamma0 in AMPLITUDES}
    plain = amplitudes[1e-3]
    standard = Experiment(pack, six_signals(), t0=t0)
    stores = {store: plain if store == STANDARD_STORE else having(store=store) for store in STORES}
    scale = float(np.asarray(standard.compression)) * 1e-3
    free, twice, before = having(store=max(STORES), hold_drag=0.0), having(background="sub2"), having(shear="before")
    # The last two run anew what `plain` ran: its walls are as fast as theirs.
    return [
        _told(stress_is_minus_j(plain), plain),
        _told(speeds_decay(free, t0), free),
        _told(storage_costs_nothing(stores), *stores.values()),
        _told(reading_erases(twice, scale), twice),
        _told(order_matters(plain, before, scale), plain, before),
        _told(proportional(amplitudes), *amplitudes.values()),
        _told(rearranges(tetra, spheres, t0), plain),
        _told(forces_tell_nothing(standard), plain),
    ]


def _told(verdict: Verdict, *recalls: Recall) -> Verdict:
    """The verdict with the status of its runs; without an answer if that makes them no evidence, or a number is NaN."""
    status = combined_status([combined_status(recall.status) for recall in recalls])
    known = [*verdict.values.values()]
    numbers = [number for one in known for number in (one.values() if isinstance(one, Mapping) else (one,))]
    if status & UNTOLD:
        verdict = verdict._replace(holds=None, why=explain(status))
    elif np.any(np.isnan(numbers)):
        verdict = verdict._replace(holds=None, why="a measure is no number")
    return verdict._replace(status=status)
