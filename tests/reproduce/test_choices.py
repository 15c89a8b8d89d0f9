"""What the paper leaves open: each choice is a parameter with its default, is written down, and is weighed."""

import math
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from scenes import TETRA_27, strain_path

import gmem_jax as gm
from gmem_jax.experiment.identity import fingerprint
from gmem_jax.experiment.record import signals_to_dict, to_dict
from gmem_jax.experiment.signals import bit_width, words
from gmem_jax.files.configuration import named_experiment
from gmem_jax.files.waveforms import named_signals, signals_from_dict
from gmem_jax.physics.contact.kinematics import transport
from gmem_jax.physics.contact.path import led_contact
from gmem_jax.reproduce import choices
from gmem_jax.reproduce.choices import CHOICES, choice_points, effects
from gmem_jax.reproduce.compare import write_csv
from gmem_jax.simulation.stage import Bin
from gmem_jax.simulation.strain import StrainPath

PACK = gm.load_pack(TETRA_27)


def test_defaults_are_those_that_the_table_of_choices_names() -> None:
    for choice in CHOICES:
        name, value = choice.name, choice.values[0]
        plain = named_experiment(PACK, choice.shared)
        assert to_dict(named_experiment(PACK, {**choice.shared, name: value})) == to_dict(plain), name
        for other in choice.values[1:]:
            assert to_dict(named_experiment(PACK, {**choice.shared, name: other})) != to_dict(plain), name


@pytest.mark.parametrize("share", [0.25, 1.0])
def test_the_share_of_the_shear_goes_to_each_axis(share: float) -> None:
    lower, upper = -jnp.ones((3, 1)), jnp.ones((3, 1))
    row, time = Bin(0.0, 1.0, 1, 0, timed=False, still=False, amplitudes=(1.0,)), jnp.asarray(0.3)
    sheared = strain_path(lower, upper, 0.05, 0.01, gm.six_signals(), share=share).box_at(row, time, 1.0).lengths
    plain = StrainPath(lower, upper, 0.05).box_at(row._replace(amplitudes=()), time, 1.0).lengths
    np.testing.assert_allclose(sheared[:, 1], plain[:, 0] * np.array([1.0 - 0.01 * share, 1.0 + 0.01 * share, 1.0]))


def test_soft_walls_leave_the_contacts_of_grains_alone() -> None:
    soft, rigid = gm.Material(wall_rigidity=0.5), gm.Material()
    assert soft.wall_stiffness == 0.5 * rigid.wall_stiffness
    assert (soft.normal_stiffness, soft.mindlin_stiffness) == (rigid.normal_stiffness, rigid.mindlin_stiffness)


@pytest.mark.parametrize("law", [gm.Hooke, gm.MindlinRescaled])
def test_a_law_without_spinning_keeps_its_force_when_a_contact_turns(law: type) -> None:
    still = led_contact(jnp.asarray([0.1]), jnp.asarray([0.0]), 0.3)
    kin = type(still)(**{**vars(still), "twist": jnp.full_like(still.twist, 0.02)})
    force = 1e-3 * jnp.asarray([1.0, 0.0, 0.0])[None, :, None]
    limit = jnp.ones((1, 1, 1))
    for spinning, across in ((0.0, 0.0), (1.0, 6e-6)):
        made = law(spinning=spinning)
        blank = made.init(1, 1, float)
        history = force if law is gm.Hooke else type(blank)(force, jnp.full((1, 1, 1), 0.1))
        np.testing.assert_allclose(np.asarray(made(kin, limit, history)[0])[0, 1, 0], across, atol=1e-9)


def test_a_history_without_spinning_does_not_turn_about_the_normal() -> None:
    kin = led_contact(jnp.asarray([0.1]), jnp.asarray([0.0]), 0.3)
    twisting = type(kin)(**{**vars(kin), "twist": jnp.full_like(kin.twist, 0.02)})
    force = jnp.asarray([1.0, 0.0, 0.0])[None, :, None]
    np.testing.assert_array_equal(transport(force, twisting, 0.0), force)
    turned = np.asarray(transport(force, twisting))[0, :, 0]
    np.testing.assert_allclose(turned, [math.cos(6e-3), math.sin(6e-3), 0.0], atol=1e-7)  # right to third order


@pytest.mark.parametrize(("pad", "width"), [(3.0, 1.0), (1.5, 0.75), (1.0, 2.0)])
def test_words_of_other_pads_and_widths_are_written_by_them(pad: float, width: float) -> None:
    signals = named_signals("words:3", pad, width)
    form = signals_to_dict(signals)
    assert form == {"kind": "words", "bits": 3, "pad": pad, "width": width}
    assert fingerprint(signals_from_dict(form)) == fingerprint(signals)
    u_b = bit_width(3, pad)
    assert u_b == 1.0 / (3.0 + 2.0 * pad)
    free = np.asarray(signals.shear(jnp.asarray([0.0, 0.999 * (pad - 0.5 * width) * u_b])))
    assert np.all(free == 0.0)
    # The plateau of the last bit, 1 in every other word: half its bumps' area above or below zero.
    last = np.asarray(signals.integral(jnp.asarray((pad + 2.5) * u_b)))
    if width <= 1.0:
        np.testing.assert_allclose(last, np.where(np.arange(8) % 2, 1.0, -1.0) * width * u_b / math.pi, atol=1e-12)


def test_words_that_do_not_fit_and_pads_of_other_signals_are_refused() -> None:
    with pytest.raises(ValueError, match=r"must be in \(0, 2 pad\] = \(0, 1\] bits wide, got 1.5"):
        words(3, pad=0.5, width=1.5)
    with pytest.raises(ValueError, match="are for words:L only"):
        named_signals("six", 3.0)


def test_every_value_is_tried_once_on_every_pack() -> None:
    packs = [{"pack": "a"}, {"pack": "b"}]
    rows = [tuple(sorted(values.items())) for values in choice_points(packs)]
    assert len(set(rows)) == len(rows)
    assert {"pack": "a"} in choice_points(packs)
    assert {"pack": "b", "friction": "M2", "variant": "paper"} in choice_points(packs)


def test_effects_are_differences_on_the_same_pack(tmp_path: Path) -> None:
    packs = [{"pack": "a"}, {"pack": "b"}]

    def summary(gain: float, fidelity: float) -> dict[str, float]:
        return {"windowed_gain": gain, "windowed_fidelity": fidelity, "gain": 0.0, "fidelity": 0.0, "status": 0}

    runs = [
        ({"pack": "a"}, summary(0.2, 0.7)),
        ({"pack": "b"}, summary(0.4, 0.9)),
        ({"pack": "a", "stiffness": 0.18}, summary(0.22, 0.6)),
        ({"pack": "b", "stiffness": 0.18}, summary(0.48, 0.8)),
        ({"pack": "a", "dt": 1.2}, summary(0.2, 0.7)),  # steps longer than a bin: the run of the default
        ({"pack": "b", "dt": 1.2}, summary(0.4, 0.9)),
    ]
    found = {(effect.choice.name, effect.value): effect for effect in effects(packs, runs, 1.8e3)}
    stiff = found["stiffness", 0.18]
    assert (stiff.of_gain.mean, stiff.of_fidelity.mean) == (pytest.approx(0.15), pytest.approx(-0.1))
    assert (stiff.of_gain.sd, stiff.of_gain.packs) == (pytest.approx(0.1 / math.sqrt(2.0)), 2)
    assert found["stiffness", 0.13].default
    assert ("stiffness", 0.10) not in found  # not run
    assert ("dt", 1.2) not in found
    write_csv(tmp_path / "choices.csv", choices.effect_rows(list(found.values())))
    assert (tmp_path / "choices.csv").read_text().count("\n") == 1 + len(found)
    choices.draw(tmp_path / "choices.png", list(found.values()), "two packs")
    assert (tmp_path / "choices.svg").stat().st_size > 200
