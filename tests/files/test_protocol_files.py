"""Protocols as TOML: what files say, what is refused and how, and the sets of waveforms that they name."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scenes import TETRA_27

import gmem_jax as gm
from gmem_jax.experiment import protocols
from gmem_jax.files.configuration import named_experiment
from gmem_jax.files.protocols import named_protocol, read_protocol, ready_protocols
from gmem_jax.files.waveforms import named_signals
from gmem_jax.simulation.protocol import Protocol
from gmem_jax.simulation.stage import Drive, Stage

PACK = gm.load_pack(TETRA_27)
MINE = """
[[stage]]
kind = "cycle"
to = 0.5
[[stage]]
kind = "write"
amplitude = 2
xy = "first"
z = [0.5, 1.0, 0.5]
[[stage]]
name = "wait"
role = "hold"
length = 0.5
drag = 0.1
[[stage]]
kind = "hold"
name = "servo"
length = 0.1
pressure = {z = 2e-3}
friction = false
[[stage]]
kind = "shake"
amplitude = 0.1
periods = 3
[[stage]]
kind = "train"
times = 2
waveform = "first"
[[stage]]
kind = "read"
to = 0.25
length = 0.75
of = "write"
[[stage]]
kind = "read"
name = "late"
to = "stay"
xy = "sine:1"
along = "time"
[signals]
first = "words:1"
"""


def built() -> Protocol:
    return gm.Protocol(
        gm.cycle(to=0.5),
        gm.write(amplitude=2.0, xy="first", z=[0.5, 1.0, 0.5]),
        Stage("wait", length=0.5, role="hold", drag=0.1),
        Stage("servo", length=0.1, role="hold", pressure=(None, None, 2e-3), friction=False),
        gm.shake(0.1, 3),
        gm.train(2, "first"),
        gm.read(to=0.25, length=0.75, of="write"),
        Stage("late", role="read", drives=(Drive("xy", "sine:1"),), along="time"),
    )


def put(folder: Path, text: str) -> Path:
    path = folder / "mine.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_file_makes_the_protocol_that_the_builders_make(tmp_path: Path) -> None:
    path = put(tmp_path, f"\ufeff{MINE}")
    assert gm.load_protocol(path) == built()
    assert read_protocol(path).signals == (("first", "words:1"),)
    experiment = named_experiment(PACK, {"protocol": str(path)})
    assert experiment.signals.count == 2
    assert list(experiment.sets) == ["first"]
    assert experiment.protocol == built().with_sets(["first"])


def test_what_is_saved_is_loaded(tmp_path: Path) -> None:
    for protocol in (built(), built().with_sets(["first"]), gm.Protocol(gm.write(), Stage("é \"'\\", 1.0), gm.read())):
        gm.save_protocol(tmp_path / "a.toml", protocol)
        assert gm.load_protocol(tmp_path / "a.toml") == protocol


WRITE, READ = '[[stage]]\nkind = "write"\n', '[[stage]]\nkind = "read"\n'
REFUSED = {
    "stage = 3": "made of tables [[stage]]",
    "": "made of tables [[stage]]",
    "[[stage]\n": "not TOML",
    f"{WRITE}[[stages]]": "no table 'stages' in a protocol; there are [[stage]] and [signals]",
    f'{WRITE}[[stage]]\nkind = "wait"': "stage 2: its kind must be one of cycle, rest, hold, compress",
    f'{WRITE}[[stage]]\nkind = "hold"\nlenght = 2.0': "stage 2: a stage of kind 'hold' has no 'lenght'; it has length",
    '[[stage]]\nkind = "compress"': "stage 1: a stage of kind 'compress' needs to",
    '[[stage]]\nkind = "shake"\namplitude = 1.0': "stage 1: a stage of kind 'shake' needs periods",
    '[[stage]]\nrole = "hold"': "stage 1: a stage without a kind needs name",
    '[[stage]]\nkind = "hold"\nlength = "2"': 'stage 1: length must be a number, got "2"',
    '[[stage]]\nkind = "hold"\nlength = true': "stage 1: length must be a number, got true",
    '[[stage]]\nkind = "hold"\nlength = nan': "stage 1: length must be a number, got NaN",
    '[[stage]]\nkind = "hold"\nmark = 1': "stage 1: mark must be true or false, got 1",
    '[[stage]]\nkind = "cycle"\nname = "a"': "stage 1: a stage of kind 'cycle' has no 'name'; it has rest, hold, to",
    '[[stage]]\nkind = "compress"\nto = "stay"': 'stage 1: to must be a number, got "stay"',
    '[[stage]]\nkind = "hold"\npressure = [1, 2, 3]': "pressure must be numbers by axis, as {z = 2e-3}",
    '[[stage]]\nkind = "hold"\npressure = {w = 1}': "pressure must be numbers by axis, as {z = 2e-3}",
    '[[stage]]\nkind = "hold"\npressure = {z = 0}': "stage 1: stage 'hold': its pressure is three numbers above 0",
    '[[stage]]\nkind = "train"\ntimes = 1.5': "stage 1: times must be a whole number from 1 to 10000, got 1.5",
    '[[stage]]\nkind = "train"\ntimes = 10000\n' * 2: "stage 2: more than 10000 stages",
    f"{WRITE}xy = 3": 'xy must be the name of a set, "sine:n", or two or more samples; got 3',
    f"{WRITE}xy = [1.0]": "two or more samples; got [1.0]",
    f'{WRITE}wy = "six"': "stage 1: a stage of kind 'write' has no 'wy'; it has waveform, to, length, amplitude",
    '[[stage]]\nname = "a"\ndrives = [{chanel = "xy"}]': "stage 1: a drive has no 'chanel'; it has channel, waveform",
    '[[stage]]\nname = "a"\ndrives = {channel = "xy"}': "drives must be tables",
    f"{WRITE}{READ}to = 0.5\nlength = 0.0": "stage 2: the walls would jump: stage 'read' changes u in no time",
    f"{READ}{WRITE}": "stage 1: stage 'read' reads before anything was written",
    f'{WRITE}{READ}of = "a"\n[[stage]]\nkind = "rest"': "stage 2: stage 'read' is compared with 'a'",
    f"{WRITE}[signals]": '[signals] is a table of sets by name, as xy = "six"',
    f"{WRITE}[signals]\nxy = 3": '[signals] xy: must be "six", "words:L" or a file, got 3',
    f'{WRITE}[signals]\n"a b" = "six"': "the name of a set is made of letters",
}


@pytest.mark.parametrize(("text", "reason"), REFUSED.items())
def test_what_makes_no_protocol_is_refused_in_one_line_that_names_the_stage(
    tmp_path: Path, text: str, reason: str
) -> None:
    path = put(tmp_path, text)
    with pytest.raises(gm.FileFormatError) as refusal:
        gm.load_protocol(path)
    said = str(refusal.value)
    assert said.startswith(f"{path}: ")
    assert reason in said
    assert "\n" not in said


def test_a_file_that_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no such file"):
        gm.load_protocol(tmp_path / "a.toml")


def test_protocols_have_names(monkeypatch: pytest.MonkeyPatch) -> None:
    def twice(length: float = 1.0) -> Protocol:
        return gm.Protocol(gm.write(), gm.hold(length), gm.read(), gm.write(), gm.read())

    monkeypatch.setattr(twice, "__module__", protocols.__name__)
    monkeypatch.setattr(protocols, "twice", twice, raising=False)
    assert "memory_protocol" not in ready_protocols()  # it needs arguments
    assert named_protocol("twice").protocol == twice()
    experiment = named_experiment(PACK, {"protocol": "twice", "protocol.hold.length": 3, "protocol.read-2.of": "write"})
    stages = {stage.name: stage for stage in experiment.protocol}
    assert (stages["hold"].length, stages["read-2"].of) == (3.0, "write")
    with pytest.raises(ValueError, match=r'protocol "thrice": must be a .toml file or one of .*twice'):
        named_protocol("thrice")


def test_stages_of_the_papers_protocol_have_values_too() -> None:
    experiment = named_experiment(PACK, {"protocol.store.length": 0.5, "protocol.encode.amplitude": 0.1})
    stages = {stage.name: stage for stage in experiment.protocol}
    assert stages["store"].length == 0.5
    assert stages["encode"].drives[0].amplitude == 0.1
    assert stages["rest"].length == gm.Experiment.rest


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"store": 2.0}, "store does nothing: stages of the protocol say that"),
        ({"signals": "six"}, r"signals does nothing: the protocol has \[signals\] of its own"),
        ({"word_pad": 2.0}, "word_pad does nothing"),
        ({"protocol.wait.lenght": 1.0}, "a stage has no 'lenght'"),
        ({"protocol.store.length": 1.0}, "the protocol has no stage 'store'; it has rest, compress"),
        ({"protocol.wait.length": "long"}, 'length must be a number, got "long"'),
        ({"protocol.wait.friction": 0}, "friction must be true or false, got 0"),
        ({"protocol": 3}, "protocol 3: must be a .toml file"),
    ],
)
def test_values_that_do_nothing_or_are_none_are_refused(tmp_path: Path, values: dict[str, Any], reason: str) -> None:
    path = put(tmp_path, MINE)
    with pytest.raises(ValueError, match=reason):
        named_experiment(PACK, {"protocol": str(path), **values})


def test_several_sets_of_waveforms_have_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    np.savetxt("a,b.csv", np.ones((4, 2)), delimiter=",")
    both: Any = named_signals("xy=words:1,z=a,b.csv", pad=None)
    assert both.names == ("xy", "z")
    assert both.count == both.sets[0].count == 2
    assert isinstance(both.sets[1], gm.Spline)
    Path("z=c.csv").write_text(Path("a,b.csv").read_text())
    assert isinstance(named_signals("z=c.csv"), gm.Spline)
    with pytest.raises(ValueError, match="have different names"):
        named_signals("xy=six,xy=six")
