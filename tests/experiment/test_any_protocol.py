"""Protocols of one's own: what is read of them, by read and channel; held walls; observers; what is refused."""

import json
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import TETRA_27

import gmem_jax as gm
from gmem_jax.derivatives.push import push
from gmem_jax.experiment import analysis
from gmem_jax.experiment.protocols import memory_protocol
from gmem_jax.experiment.readings import placed, rates_of
from gmem_jax.experiment.record import key_of_run
from gmem_jax.experiment.signals import bin_average
from gmem_jax.files.measures import of_each
from gmem_jax.simulation.channels import CHANNELS
from gmem_jax.simulation.protocol import Protocol
from gmem_jax.simulation.stage import Drive, Stage

PACK = gm.load_pack(TETRA_27)
ONE = gm.Bumps(jnp.asarray([[1.0], [-1.0]]), jnp.full((2, 1), 0.5), 0.6)
OTHER = gm.Bumps(jnp.asarray([[1.0], [1.0]]), jnp.full((2, 1), 0.4), 0.6)
QUICK: dict[str, Any] = {"t0": 40.0, "gamma0": 0.01}
READ = gm.Protocol(gm.write(), gm.hold(0.1), gm.read())
HALF = (*gm.Protocol(gm.write()), Stage("a", 1.0, 0.5, role="read"))


def experiment(protocol: Protocol | None = READ, signals: Any = ONE, **changes: Any) -> gm.Experiment:
    return gm.Experiment(PACK, signals, protocol=protocol, **{**QUICK, **changes})


def run(*arguments: Any, **changes: Any) -> gm.Recall:
    return gm.run(experiment(*arguments, **changes), progress=False)


def test_the_papers_protocol_by_builders_is_the_papers() -> None:
    built = gm.Protocol(gm.cycle(0.1, 0.1), gm.rest(0.1), gm.write(), gm.hold(0.2), gm.read())
    lengths = {"rest": 0.1, "hold": 0.1, "store": 0.2}
    one, other = run(built), run(None, **lengths)
    np.testing.assert_array_equal(one.p_sig, other.p_sig)
    assert gm.Experiment(PACK, ONE, **lengths).is_paper
    assert not experiment(built).is_paper
    explicit = experiment(memory_protocol(0.1, 0.1, 0.2, second_readout=False), **lengths)
    assert explicit.is_paper
    assert gm.replace(explicit, store=0.3) == gm.replace(experiment(None, **lengths), store=0.3)


def test_stages_go_on_where_the_one_before_ends_and_have_names_of_their_own() -> None:
    protocol = gm.Protocol(gm.cycle(to=0.5), gm.cycle(), gm.write(), gm.read(to=0.25), gm.hold(), gm.read())
    assert [stage.ends for stage in protocol][:4] == [(0.0, 0.0), (0.0, 0.5), (0.5, 0.5), (0.5, 0.0)]
    assert [stage.ends for stage in protocol][-3:] == [(1.0, 0.25), (0.25, 0.25), (0.25, 0.0)]
    assert [stage.name for stage in protocol][4:8] == ["rest-2", "compress-2", "hold-2", "decompress-2"]
    assert len({stage.name for stage in protocol}) == len(protocol)
    written = json.loads(json.dumps(protocol.to_list()))
    assert Protocol.from_list(written) == protocol
    assert "drag" not in written[0]
    with pytest.raises(ValueError, match="'rest' is there 2 times"):
        Protocol.from_list([written[0], written[0]])


REFUSED = {
    "the walls would jump: stage 'write' ends at u = 1, and 'a' begins at u = 0.5": (gm.write(), Stage("a", 0.5, 1.0)),
    "changes u in no time": (Stage("a", 0.0, 1.0, 0.0),),
    "'read' reads before anything was written": (gm.compress(1.0), gm.read(), gm.write(to=0.0)),
    "waveforms vanish only at u = 0 and 1": (gm.write(to=0.5), gm.read()),
    "is compared with 'other', and what was written before it is write": (gm.write(), gm.read(of="other")),
    "at least one stage": (),
    "made of stages": (gm.write(), 2.0),
}


@pytest.mark.parametrize(("reason", "stages"), REFUSED.items())
def test_what_makes_no_protocol_is_refused(reason: str, stages: tuple[Any, ...]) -> None:
    with pytest.raises(ValueError, match=reason):
        Protocol(*stages)


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"stop": 1.2}, r"u must be in \[0, 1\], and its stop is 1.2"),
        ({"stop": "stay"}, "its stop must be a number, got 'stay'"),
        ({"role": "write"}, "it writes no waveform"),
        (
            {"role": "write", "drives": [gm.Drive("xy", "xy"), gm.Drive("xy", "b")]},
            "two sets of waveforms on one channel",
        ),
        ({"along": "x"}, "along must be one of u, time"),
        ({"drag": -1.0}, r"drag must be in \[0, inf\)"),
        ({"pressure": (0.0, None, None)}, "three numbers above 0 or none"),
        ({"of": "write"}, "only a stage that reads"),
        ({"role": "read", "recorded": False}, "so it must be recorded"),
        ({"name": "a/b"}, "without '/'"),
        ({"name": "."}, "not '.'; got '.'"),
        ({"name": "x" * 200}, "a name of 1 to 150 printable letters"),
        ({"length": 1e308}, r"its length may be up to 1e\+09 t0, got 1e\+308"),
    ],
)
def test_what_makes_no_stage_is_refused(fields: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        Stage(**{"name": "a", **fields})


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("ab", "xy"), "a channel must be one of xy, z"),
        (("xy", "sine:0"), "whole periods"),
        (("xy", [1.0]), "2 or more finite samples"),
        (("", "sine:1"), "needs a channel"),
        (("xy", "xy", float("nan")), "amplitude of a drive must be a finite number"),
    ],
)
def test_what_makes_no_drive_is_refused(arguments: tuple[Any, ...], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        Drive(*arguments)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"store": 1.0}, "store belongs to the paper's protocol, and another is given"),
        ({"background": "sub2"}, "needs two reads, the second for the background of the first; the protocol has 1"),
        (
            {"protocol": gm.protocols.partial_readout(to=0.5), "background": "sub2"},
            "'read-part' goes from u = 1 to 0.5, and 'read-again' from 1 to 0",
        ),
        (
            {
                "protocol": Protocol(*HALF, Stage("back", 0.5, 1.0), Stage("b", 1.0, 0.5, role="read")),
                "background": "sub2-bl",
            },
            "a straight line over all u; 'a' ends before",
        ),
        ({"protocol": Protocol(*READ, Stage("r", 0.0, 0.0, role="read", length=0.0))}, "stage 'r' reads in no time"),
        ({"protocol": gm.Protocol(gm.write())}, "no stage that reads"),
        ({"protocol": Protocol(Stage("a", 1.0, 0.0), *READ)}, "rests at u = 0, and stage 'a' begins at u = 1"),
        ({"protocol": gm.Protocol(gm.write([0.5, 1.0, 0.5]), gm.read())}, "writes no waveforms of the replicas"),
        ({"protocol": gm.Protocol(gm.write("first"), gm.read())}, "writes 'first', and the sets of waveforms are xy"),
        ({"protocol": READ.stages}, "must be a gm.Protocol, got a tuple"),
        ({"protocol": None, "signals": gm.signals(first=ONE, second=ONE)}, "give a protocol with stages"),
        ({"protocol": None, "signals": gm.signals(xy=ONE, z=ONE)}, "alike in all replicas"),
    ],
)
def test_experiments_that_make_no_sense_are_refused(changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        experiment(**changes)


def test_sets_have_one_length_and_a_name() -> None:
    with pytest.raises(ValueError, match="sets of waveforms have one length"):
        gm.signals(first=ONE, second=gm.six_signals())
    with pytest.raises(ValueError, match='cannot be called "kind"'):
        gm.signals(kind=ONE)
    assert gm.signals(xy=ONE) is ONE


def test_each_read_is_compared_with_what_was_written_last() -> None:
    sets = gm.signals(first=ONE, second=OTHER)
    stages = (gm.write("first"), gm.read("one"), gm.write("second"), gm.read("two"), gm.write("first", amplitude=2.0))
    recall = run(gm.Protocol(*stages, gm.read("three"), gm.hold(0.1)), sets)
    assert (recall.reads, recall.channels, np.shape(recall.p_sig)) == (("one", "two", "three"), ("xy",), (3, 2, 256))
    first, second = (np.asarray(gm.Experiment(PACK, one, **QUICK).integral()) for one in (ONE, OTHER))
    np.testing.assert_allclose(recall.J, [first, second, 2.0 * first], rtol=1e-14)
    for number, name in enumerate(recall.reads):
        one = recall.at(name)
        p_xy = analysis.recalled(jnp.asarray(recall.stages[name].pressure))
        np.testing.assert_array_equal(one.p_sig, analysis.subtract("sub0", p_xy))
        match = analysis.compare(one.p_sig, one.J, experiment().scale)
        np.testing.assert_allclose([one.gain, one.fidelity], match, rtol=1e-13)
        assert one.gain == recall.gain[number] == recall.at(number).gain
    of = experiment(gm.Protocol(*stages, gm.read(of="write")), sets)
    np.testing.assert_allclose(of.integral()[2], first, rtol=1e-14)


def test_a_channel_beside_a_silent_one_has_the_numbers_of_one_alone() -> None:
    silent = gm.Bumps(jnp.zeros((2, 1)), jnp.full((2, 1), 0.5), 0.6)
    alone, both = run(None, ONE, store=0.1), run(None, gm.signals(xy=ONE, z=silent), store=0.1)
    assert both.channels == ("xy", "z")
    np.testing.assert_allclose(both.at(channel="xy").p_sig, alone.p_sig, atol=1e-12 * np.abs(alone.p_sig).max())
    np.testing.assert_allclose(both.gain[0, 0], alone.gain, rtol=1e-12)
    np.testing.assert_allclose(both.fidelity[0], alone.fidelity, rtol=1e-12)
    assert np.isnan(both.fidelity[1])
    assert np.all(np.isnan(both.gain[:, 1]))


def test_a_channel_strains_the_box_by_its_mode_and_reads_the_stress_of_it() -> None:
    box = np.asarray(PACK.upper - PACK.lower)
    for name, channel in CHANNELS.items():
        one = experiment(gm.Protocol(gm.write(**{name: "xy"}), gm.read()))
        simulation = one.simulation(sheared=True)
        row = simulation.rows(one.protocol.stages[0], 127)
        now = simulation.path.box_at(row, jnp.asarray(128.0), 256.0)
        shape = np.sqrt(1.0 - PACK.delta0 * 1.0)
        squeeze = np.array([1.0, 1.0, 0.0]) * (1.0 - shape) * 0.5
        wanted = box[:, None] * (1.0 - squeeze[:, None]) * (1.0 + np.outer(channel.mode, [0.0, 0.01, -0.01]))
        np.testing.assert_allclose(now.lengths, wanted, rtol=1e-13, err_msg=name)
        pressure = np.array([[[1.0], [2.0], [4.0]]])
        assert channel.stress(pressure)[0, 0] == pytest.approx(-2.0 * np.dot(channel.mode, [1.0, 2.0, 4.0]))


def test_cross_talk_is_found_where_it_was_put() -> None:
    rng = np.random.default_rng(0)
    templates = rng.normal(size=(2, 3, 256))
    mixing = np.array([[0.5, 0.1], [-0.2, 0.3]])
    signal = 0.01 * np.einsum("cd,dsu->csu", mixing, templates)
    match = analysis.compare_channels(jnp.asarray(signal), jnp.asarray(templates), 0.01)
    np.testing.assert_allclose(match.gain, mixing, rtol=1e-12)
    own = 0.01 * np.diagonal(mixing)[:, None, None] * templates
    miss = np.sum((signal - own) ** 2, axis=(1, 2)) / np.sum(signal**2, axis=(1, 2))
    np.testing.assert_allclose(match.fidelity, 1.0 - np.sqrt(miss), rtol=1e-12)


@pytest.mark.parametrize(
    ("start", "stop", "length"), [(1.0, 0.0, 2.0), (1.0, 0.25, 0.75), (0.25, 1.0, 0.5), (1.0, 0.0, 0.3)]
)
def test_what_is_read_is_put_where_u_is(start: float, stop: float, length: float) -> None:
    stage = Stage("read", start, stop, length, "read")
    u = start + (stop - start) * (np.arange(stage.bins) + 0.5) / stage.bins
    found = np.asarray(placed(stage, jnp.asarray(np.stack([u, 1.0 + u], axis=1))))
    centres = (np.arange(256) + 0.5) / 256
    inside = (centres > min(start, stop)) & (centres < max(start, stop))
    coarse = 0.5 * abs(stop - start) / stage.bins  # a bin of the stage holds several of u
    np.testing.assert_allclose(found[0][inside], centres[inside], atol=1e-12 + coarse)
    np.testing.assert_allclose(found[1][inside] - found[0][inside], 1.0, rtol=1e-12)
    assert not np.any(found[:, ~inside])


def test_held_walls_come_to_the_pressure_and_give_way() -> None:
    target = 1.5 * float(np.asarray(run().stages["hold"].pressure)[-1, 2, 0])
    held = run(gm.Protocol(gm.write(), gm.hold(2.0, pressure=(None, None, target)), gm.read()), t0=200.0)
    sample = held.stages["hold"]
    assert abs(np.asarray(sample.pressure)[-64:, 2].mean() / target - 1.0) < 0.05
    lengths = np.asarray(sample.lengths)
    assert np.all(lengths[-1, 2] < lengths[0, 2])
    np.testing.assert_array_equal(lengths[:, :2], np.broadcast_to(lengths[:1, :2], lengths[:, :2].shape))
    after = np.asarray(held.stages["read"].lengths)
    np.testing.assert_allclose(after[:, 2], np.broadcast_to(lengths[-1, 2], after[:, 2].shape), rtol=1e-13)


def test_friction_drag_and_fixed_waveforms_are_those_of_the_stage() -> None:
    base = run()
    free = run(gm.Protocol(gm.write(), gm.hold(0.1, friction=False), gm.read()))
    np.testing.assert_array_equal(free.stages["write"].pressure, base.stages["write"].pressure)
    assert np.abs(np.asarray(free.p_sig) - np.asarray(base.p_sig)).max() > 1e-3 * np.abs(base.p_sig).max()
    same = run(gm.Protocol(gm.write(), gm.hold(0.1, drag=float(experiment().drag)), gm.read()))
    np.testing.assert_allclose(same.p_sig, base.p_sig, atol=1e-12 * np.abs(base.p_sig).max())
    shaken = run(gm.Protocol(gm.write(), gm.shake(0.5, 2, length=0.1), gm.hold(0.1), gm.read()))
    swing = np.asarray(shaken.stages["shake"].lengths)[:, 0]
    np.testing.assert_array_equal(swing, np.broadcast_to(swing[:, :1], swing.shape))  # the zero signal's, too
    bins = len(swing)
    wanted = 1.0 - 0.5 * 0.5 * 0.01 * np.sin(2 * np.pi * 2 * np.arange(1, bins + 1) / bins)
    np.testing.assert_allclose(swing[:, 0] / swing[-1, 0], wanted / wanted[-1], rtol=1e-12)
    fixed = experiment(gm.Protocol(gm.write([0.5, 1.0, 0.5], name="before"), gm.read(), gm.write(), gm.read())).protocol
    assert not fixed.stages[0].own


def moved(simulation: Any, state: Any) -> jax.Array:
    """Mean square of the displacement since the mark, [B]."""
    change = state.grains.position - simulation.mark.grains.position
    return jnp.mean(jnp.sum(change**2, axis=1), axis=0)


def test_observers_see_every_bin_and_change_nothing() -> None:
    plain, watched = experiment(), experiment(observe={"moved": moved})
    assert key_of_run(plain) != key_of_run(watched)
    assert gm.to_dict(plain) == gm.to_dict(watched)
    base, seen = run(), run(observe={"moved": moved, "box": lambda simulation, state: simulation.box.lengths})
    np.testing.assert_array_equal(seen.p_sig, base.p_sig)
    for name, sample in seen.stages.items():
        np.testing.assert_array_equal(sample.observed["box"], sample.lengths, err_msg=name)
    assert np.all(np.diff(seen.stages["write"].observed["moved"][64:128], axis=0) > 0.0)
    whole = gm.recall(experiment(observe={"moved": moved}))
    for name, sample in whole.stages.items():
        np.testing.assert_allclose(sample.observed["moved"], seen.stages[name].observed["moved"], rtol=1e-6)
    marked = gm.Protocol(gm.write(), gm.hold(0.1), Stage("read", 1.0, 0.0, 1.0, "read", mark=True))
    late = run(marked, observe={"moved": moved})
    assert float(np.max(late.stages["read"].observed["moved"][0])) < 1e-3 * float(
        np.max(late.stages["hold"].observed["moved"])
    )
    batches = gm.run(experiment(marked, observe={"moved": moved}), batch=1, progress=False)
    np.testing.assert_allclose(
        batches.stages["read"].observed["moved"], late.stages["read"].observed["moved"], rtol=1e-9
    )
    at_once = gm.recall(experiment(marked, observe={"moved": moved}))  # there is no prefix that could have a mark
    for name, sample in at_once.stages.items():
        np.testing.assert_allclose(sample.observed["moved"], late.stages[name].observed["moved"], rtol=1e-6)


def test_observers_do_not_disturb_derivatives() -> None:
    one = experiment(t0=20.0)
    plain, watched = (
        gm.value_and_grad(e, ["gamma0"], progress=False) for e in (one, gm.replace(one, observe={"moved": moved}))
    )
    np.testing.assert_array_equal(watched.slope["gamma0"], plain.slope["gamma0"])
    pushed = [push(e, {"gamma0": 1.0}).p_sig_slope for e in (one, gm.replace(one, observe={"moved": moved}))]
    np.testing.assert_array_equal(*pushed)


def test_a_loss_of_several_numbers_is_refused_with_one_that_would_do() -> None:
    twice = experiment(gm.Protocol(gm.write(length=0.1), gm.read("a", length=0.1), gm.write(length=0.1), gm.read("b")))
    with pytest.raises(ValueError, match=r"a loss is one number, got \(2,\): with several reads or channels give one"):
        gm.value_and_grad(twice, ["gamma0"], progress=False)


def test_a_recall_of_several_reads_and_channels_is_kept_whole(tmp_path: Any) -> None:
    sets = gm.signals(xy=ONE, z=OTHER)
    two = gm.Protocol(gm.write(), gm.read("one", to=0.5, length=0.5), gm.read("two", to=0.0, length=0.5))
    recall = run(two, sets, observe={"moved": moved})
    gm.save_recall(tmp_path / "a.h5", recall)
    again = gm.load_recall(tmp_path / "a.h5")
    assert np.shape(again.gain) == (2, 2, 2)
    for name in ("p_sig", "J", "shear", "gain", "fidelity", "windowed_gain"):
        np.testing.assert_array_equal(getattr(again, name), getattr(recall, name))
    assert (again.reads, again.channels, again.protocol) == (recall.reads, recall.channels, recall.protocol)
    np.testing.assert_array_equal(again.stages["one"].observed["moved"], recall.stages["one"].observed["moved"])
    back = gm.from_dict(recall.configuration["experiment"], PACK)
    assert back == gm.replace(experiment(two, sets), observe=())
    assert gm.to_csv(recall).splitlines()[0].count("p_sig of") == 8
    data = gm.to_xarray(recall)
    assert data.p_sig.sel(read="two", channel="z").dims == ("signal", "u")
    assert float(data.gain.sel(read="one", channel="z", written="xy")) == float(recall.gain[0, 1, 0])


@pytest.mark.parametrize("backend", ["auto", pytest.param("jax", marks=pytest.mark.slow)])
def test_gradients_through_a_protocol_of_ones_own(backend: str) -> None:
    """Two channels, held walls, shaking, a partial read: against plain JAX and central differences."""
    stages = (gm.write(), gm.shake(0.3, 1, length=0.05, channel="z"), gm.hold(0.1, pressure=(None, None, 3e-3)))
    protocol = gm.Protocol(*stages, gm.read("half", to=0.5, length=0.3))
    sets = gm.signals(xy=ONE, z=OTHER)
    one = experiment(protocol, sets, backend=backend, t0=20.0)

    def loss(experiment: gm.Experiment, p_sig: jax.Array) -> jax.Array:
        return 1e6 * jnp.sum(p_sig[0] * p_sig[0]) + jnp.sum(experiment.compare(p_sig).gain)

    found = gm.value_and_grad(one, ["gamma0", "friction.mu"], loss=loss, progress=False)
    plain = gm.run(gm.replace(one, backend="jax"), progress=False).p_sig
    np.testing.assert_allclose(found.p_sig, plain, atol=1e-9 * float(jnp.abs(plain).max()))
    for name, slope in found.slope.items():
        middle, step = float(gm.replace(one, {}).gamma0 if name == "gamma0" else one.friction.mu), 1e-5
        values = []
        for sign in (1.0, -1.0):
            other = gm.replace(one, {name: middle * (1.0 + sign * step)})
            values.append(float(loss(other, gm.run(other, progress=False).p_sig)))
        assert float(slope) == pytest.approx((values[0] - values[1]) / (2.0 * step * middle), rel=1e-4), name


def test_two_reads_of_half_of_u_differ_where_they_read_alone() -> None:
    half = Protocol(*HALF, Stage("back", 0.5, 1.0), Stage("b", 1.0, 0.5, role="read"))
    p_sig = run(half, background="sub2").p_sig
    assert not np.any(p_sig[:, :128])
    assert np.all(p_sig[:, 128:])


@pytest.mark.parametrize("length", [0.25, 1.0, 4.0])
def test_a_read_is_averaged_over_what_it_goes_through_in_a_ringing_period(length: float) -> None:
    recall = run(gm.Protocol(gm.write(), gm.hold(0.1), gm.read(length=length)))
    part = float(PACK.ringing_period) / QUICK["t0"] / length
    match = analysis.compare(recall.p_sig, recall.J, float(PACK.delta0) * QUICK["gamma0"], part)
    np.testing.assert_allclose([recall.windowed_gain, recall.windowed_fidelity], match, rtol=1e-12)
    each = of_each(recall)["signal_windowed_fidelity"]
    alone = analysis.each(recall.p_sig, recall.J, float(PACK.delta0) * QUICK["gamma0"], part)
    np.testing.assert_allclose(each, alone.fidelity, rtol=1e-12)
    # The walls are slower in a longer read, and the same grains then less at rest.
    usual = run()
    np.testing.assert_allclose(recall.residual_speed, length * usual.residual_speed, rtol=1e-12)


def test_reads_of_several_lengths_have_a_window_each() -> None:
    protocol = gm.Protocol(gm.write(), gm.read("fast", length=0.5), gm.write("xy"), gm.read("slow", length=2.0))
    recall = run(protocol)
    for name, length in (("fast", 0.5), ("slow", 2.0)):
        one = recall.at(name)
        part = float(PACK.ringing_period) / QUICK["t0"] / length
        match = analysis.compare(one.p_sig, one.J, float(PACK.delta0) * QUICK["gamma0"], part)
        assert float(one.windowed_fidelity) == pytest.approx(float(match.fidelity), rel=1e-12)
        assert rates_of(one.protocol, one.reads) == pytest.approx(1.0 / length)
        assert one.windows(QUICK["t0"]) == pytest.approx(part, rel=1e-12)


def test_a_kernel_is_measured_with_sub0() -> None:
    with pytest.raises(ValueError, match="with 'sub2' silence has a recall"):
        gm.memory_kernel(experiment(gm.protocols.paper_twice_read(), background="sub2"), n=2, width=0.6)


def test_a_kernel_is_that_of_the_shear_that_the_stage_writes_and_of_the_bins_that_are_read() -> None:
    def measured(amplitude: float, gamma0: float, read: gm.Stage) -> gm.MemoryKernel:
        protocol = gm.Protocol(gm.cycle(), gm.write(amplitude=amplitude), read)
        return gm.memory_kernel(experiment(protocol, gamma0=gamma0), n=2, width=0.6, progress=False)

    whole, half = measured(1.0, 1e-3, gm.read()), measured(0.5, 2e-3, gm.read())  # the same shear
    np.testing.assert_allclose(half.kernel(), whole.kernel(), rtol=1e-9, atol=1e-12)
    assert half.gain() == pytest.approx(whole.gain(), rel=1e-9)
    # A read of half of u is compared with J there.
    partly = measured(1.0, 1e-3, gm.read(to=0.5, length=0.5))
    J = np.where(np.arange(256) < 128, 0.0, bin_average(partly.basis))
    expected = np.sum(J * partly.odd) / np.sum(J * J) / (float(PACK.delta0) * 1e-3)
    assert partly.gain() == pytest.approx(expected, rel=1e-9)
    assert not partly.odd[:, :127].any()


def test_a_kernel_and_a_design_are_of_a_set_of_any_name() -> None:
    protocol = gm.Protocol(gm.write(xy="mine"), gm.hold(0.1), gm.read())
    mine, plain = experiment(protocol, gm.signals(mine=ONE)), experiment(READ)
    kernels = [gm.memory_kernel(one, n=2, width=0.6, progress=False) for one in (mine, plain)]
    np.testing.assert_array_equal(kernels[0].odd, kernels[1].odd)
    designs = [
        gm.design_by_kernel(one, kernel=kernel, iterations=1, progress=False)
        for one, kernel in zip((mine, plain), kernels, strict=True)
    ]
    assert designs[0].fidelity == designs[1].fidelity
    with pytest.raises(ValueError, match="works with one set of waveforms"):
        gm.design_by_kernel(experiment(protocol, gm.signals(mine=ONE, other=OTHER)), iterations=1)


def test_kernels_of_two_channels_hold_what_each_says_of_the_other() -> None:
    one = experiment(None, gm.signals(xy=ONE, z=OTHER), store=0.1)
    matrix = gm.kernel_matrix(one, n=2, width=0.6, progress=False)
    alone = gm.memory_kernel(experiment(None, ONE, store=0.1), n=2, width=0.6, progress=False)
    np.testing.assert_allclose(matrix.blocks[0][0].odd, alone.odd, atol=1e-12 * np.abs(alone.odd).max())
    assert np.abs(matrix.blocks[1][0].odd).max() > 0.0
    # The singular values of a pack whose channels did not speak would be those of each.
    deaf = replace(alone, odd=0.0 * alone.odd)
    apart = gm.KernelMatrix(("xy", "z"), ((alone, deaf), (deaf, replace(alone, odd=2.0 * alone.odd))))
    each = alone.singular_values()
    np.testing.assert_allclose(apart.singular_values(), np.sort([*each, *(2.0 * each)])[::-1], rtol=1e-12)
    with pytest.raises(ValueError, match=r"gm.kernel_matrix measures those of several channels"):
        gm.memory_kernel(experiment(gm.Protocol(gm.write(), gm.read("a"), gm.write(), gm.read("b"))), n=2, width=0.6)
