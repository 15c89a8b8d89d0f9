"""Hostile input: mutated files and command lines, thousands of them, each of which must be refused in one line or work.

    python tests/reliability/fuzz.py 10000 --json fuzz.json

Hypothesis makes the cases. They run in children of this process, which have little memory and ten seconds for each: a
child that is killed by a signal has crashed (SIGSEGV and the like) or hung (HUNG). A new kind of input is one more
`Kind` in KINDS.
"""

import argparse
import contextlib
import io
import json
import os
import pickle
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import jax
import numpy as np
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

import gmem_jax as gm
from gmem_jax.command import app, derive, packs, recalls
from gmem_jax.command import show as showing
from gmem_jax.command.sweep import planned
from gmem_jax.errors import FileFormatError
from gmem_jax.experiment.recall import Recall
from gmem_jax.files.checkpoints import load_part, save_part
from gmem_jax.files.seal import BLOCK, seal
from gmem_jax.files.waveforms import load_target
from gmem_jax.simulation.protocol import Protocol
from gmem_jax.simulation.sample import MEASURED, Sample
from gmem_jax.simulation.stage import Drive, Stage
from gmem_jax.sweeps.spec import read_spec

MEMORY = 6 << 30  # bytes of address space that a child may add
BATCH = 250  # inputs to a child
PACK = Path(__file__).parents[1] / "data" / "tetra-27.h5"
SWEEP = f"""[experiment]
t0 = 150.0
signals = "six"
[vary]
pack = ["{PACK}"]
mu = {{from = 0.2, to = 1.0, count = 3}}
[[zip]]
gamma0 = [1e-3, 2e-3]
store = [1.0, 2.0]
[[points]]
friction = "M1"
[run]
workers = 2
"""
HUNG = (signal.SIGPROF, signal.SIGALRM)
GOOD = ("refused", "accepted")
BAD = ("lie", "traceback", "wordy", "hang", "crash")

Case = tuple[Any, ...]
Judge = Callable[[Path, Case], tuple[str, str]]
"""Feeds a case to the package, in a folder of samples: one of GOOD or BAD, and what was said."""


class Kind(NamedTuple):
    """A kind of input.

    Attributes:
        share: of all inputs.
        cases: makes them.
        judge: tries one.
        patience: seconds of CPU time for one, and 20 times as long in all.
    """

    share: float
    cases: st.SearchStrategy[Case]
    judge: Judge
    patience: float = 10.0


# ---- samples: one sound file of every kind ----


def make_samples(folder: Path) -> None:
    """Write them."""
    shutil.copy(PACK, folder / "pack.h5")
    pack = gm.load_pack(PACK)
    experiment = gm.Experiment(pack, gm.Bumps(np.ones((2, 1)), np.full((2, 1), 0.5), 0.2))
    gm.save_recall(folder / "recall.h5", _recall(experiment).described(gm.describe(experiment, 1.0)))
    save_part(folder / "part.npz", (OrderedDict(rest=_sample(4, 3)), np.arange(5)))
    from gmem_jax.reading import lessons, net, training

    small = lessons.TrainingConfig(2, hidden=(8,))
    training.save(folder / "net.msgpack", training.Training(net.initial(small, 0), 0, loss=0.5))
    waves = gm.waveform(np.sin(np.linspace(0.1, 3.0, 9)) * np.ones((6, 1)))
    gm.save_waveforms(folder / "waves.csv", waves, gm.six_signals())
    (folder / "sweep.toml").write_text(SWEEP)
    np.save(folder / "waves.npy", np.asarray(waves.nodes)[:, 1:-1])
    (folder / "folder").mkdir()
    os.mkfifo(folder / "pipe.h5")
    os.mkfifo(folder / "pipe.csv")
    (folder / "outside.bin").write_bytes(bytes(1 << 16))


def _sample(bins: int, replicas: int) -> Sample:
    wide = {name: np.full((bins, 3, replicas), 0.5) for name in ("pressure", "lengths")}
    return Sample(**{name: wide.get(name, np.full((bins, replicas), 0.1)) for name in MEASURED})


def _recall(experiment: gm.Experiment) -> Recall:
    count, u = experiment.signals.count, (np.arange(256) + 0.5) / 256
    curves = dict.fromkeys(("shear", "J", "p_sig"), np.sin(np.arange(count * 256.0)).reshape(count, 256))
    single = dict.fromkeys(("gain", "fidelity", "windowed_gain", "windowed_fidelity", "window", "dt"), np.asarray(0.25))
    stages = OrderedDict(rest=_sample(5, 1), readout=_sample(256, count + 1))
    protocol = Protocol(
        Stage("rest", 1.0, 1.0, 5 / 256, "write", (Drive("xy", "xy"),)), Stage("readout", 1.0, 0.0, 1.0, "read")
    )
    status = np.zeros(count + 1, np.int32)
    lone = {"residual_speed": np.full(count + 1, 1e-3), "rounding": np.full(count, 1e-16), "status": status}
    return Recall(
        u=u, **curves, **single, **lone, stages=stages, protocol=protocol, reads=("readout",), channels=("xy",)
    )


# ---- mutations of bytes and of what HDF5 files hold ----

_PLACE = st.integers(0, 1 << 24)
_NASTY = st.sampled_from(
    [float("nan"), float("inf"), -float("inf"), 0.0, -1.0, 1.0, 1e300, -1e300, 1e-320, 2147483647.0, -5.0, 256.0, 1e9]
)
_BYTES = st.one_of(
    st.tuples(st.just("flip"), st.lists(st.tuples(_PLACE, st.integers(0, 7)), min_size=1, max_size=3)),
    st.tuples(st.just("cut"), _PLACE),
    st.tuples(st.just("more"), st.binary(min_size=1, max_size=64)),
    st.tuples(st.just("write"), _PLACE, st.binary(min_size=1, max_size=16)),
    st.tuples(st.just("move"), _PLACE, _PLACE, st.integers(1, 64)),
)
_JSON = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(max_size=8),
    st.sampled_from(["[/x]", "\ud800", "a\nb", "\x1b[2J", 10**400, [], {}, [[[[1]]]], "x" * 5000, -1, 1e308]),
)
_H5 = st.one_of(
    st.tuples(st.just("delete"), _PLACE),
    st.tuples(st.just("swap"), _PLACE, _PLACE),
    st.tuples(
        st.just("dtype"), _PLACE, st.sampled_from(["f4", "i8", "c16", "S8", "?", ">f8", "u1", "f2", "i4", "str"])
    ),
    st.tuples(st.just("shape"), _PLACE, st.integers(0, 5)),
    st.tuples(st.just("value"), _PLACE, _PLACE, _NASTY),
    st.tuples(st.just("scale"), _PLACE, st.sampled_from([0.9, 1.1, 10.0, -1.0, 0.0, 1.0 + 1e-6])),
    st.tuples(st.just("huge"), _PLACE, st.sampled_from([10**12, 3 * 10**8, 2**62, 2**31]), st.booleans()),
    st.tuples(st.just("elsewhere"), _PLACE, st.integers(0, 5)),
    st.tuples(st.just("attribute"), _PLACE, _JSON),
    st.tuples(st.just("json"), _PLACE, _PLACE, _JSON),
)


def mutate_bytes(content: bytes, case: Case) -> bytes:
    """The content after a mutation from `_BYTES`."""
    what, *rest = case
    changed = bytearray(content)
    size = max(1, len(content))
    if what == "flip":
        for place, bit in rest[0]:
            changed[place % size] ^= 1 << bit
    elif what == "cut":
        del changed[rest[0] % size :]
    elif what == "more":
        changed += rest[0]
    elif what == "write":
        place = rest[0] % size
        changed[place : place + len(rest[1])] = rest[1]
    else:
        source, target, length = rest[0] % size, rest[1] % size, rest[2]
        changed[target : target + length] = content[source : source + length]
    return bytes(changed)


def mutate_hdf5(path: Path, case: Case) -> None:
    """Change what a file holds by a mutation from `_H5`; its seal is made anew."""
    with h5py.File(path, "r+") as file:
        names: list[str] = []
        groups = [""]
        file.visititems(lambda name, item: (names if isinstance(item, h5py.Dataset) else groups).append(name) or None)
        with contextlib.suppress(TypeError, ValueError, OverflowError):  # what HDF5 itself does not write
            _change(file, names, groups, case)
    seal(path)


def _change(file: h5py.File, names: list[str], groups: list[str], case: Case) -> None:
    what, place, *rest = case
    name = names[place % len(names)]
    if what == "delete":
        del file[(names + groups[1:])[place % (len(names) + len(groups) - 1)]]
        return
    if what in ("attribute", "json"):
        _change_attribute(file, groups, case)
        return
    values = np.asarray(file[name][()])
    if what == "swap":
        other = names[rest[0] % len(names)]
        second = np.asarray(file[other][()])
        del file[name]
        file[name] = second
        if other != name:
            del file[other]
            file[other] = values
        return
    if what == "value":
        flat = values.reshape(-1).copy()
        if flat.size:
            with np.errstate(all="ignore"):
                flat[rest[0] % flat.size] = np.asarray(rest[1]).astype(flat.dtype)
        new: Any = flat.reshape(values.shape)
    elif what == "scale":
        new = (values * rest[0]).astype(values.dtype)
    elif what == "dtype":
        new = np.full(values.shape, "words", object) if rest[0] == "str" else values.astype(rest[0])
    elif what == "shape":
        make = (
            lambda: values[..., None],
            lambda: values[..., :-1] if values.ndim else np.zeros(0),
            lambda: values.reshape(-1),
            lambda: values.T if values.ndim > 1 else np.repeat(values.reshape(1, -1), 2, axis=0),
            lambda: values[:0] if values.ndim else np.zeros((0, 3)),
            lambda: np.asarray(values.reshape(-1)[0] if values.size else 0.0),
        )
        new = make[rest[0]]()
    else:
        new = None
    del file[name]
    if new is not None:
        kind = h5py.string_dtype() if new.dtype == object else None
        file.create_dataset(name, data=new, dtype=kind)
    elif what == "huge":
        length, chunked = rest
        shape = (length, *values.shape[1:]) if values.ndim else (length,)
        file.create_dataset(name, shape, values.dtype, chunks=(1024, *values.shape[1:]) if chunked else None)
    else:
        _elsewhere(file, name, values, rest[0])


def _elsewhere(file: h5py.File, name: str, values: np.ndarray, how: int) -> None:
    outside = Path(file.filename).with_name("outside.bin")
    if how == 0:
        file[name] = h5py.ExternalLink(str(outside.with_name("pack.h5")), "/position")
    elif how == 1:
        file[name] = h5py.SoftLink("/position")
    elif how == 2:
        file.create_dataset(name, values.shape, values.dtype, external=[(str(outside), 0, values.nbytes)])
    elif how == 3 and values.ndim:
        layout = h5py.VirtualLayout(values.shape, values.dtype)
        layout[...] = h5py.VirtualSource(str(outside.with_name("pack.h5")), "position", values.shape)
        file.create_virtual_dataset(name, layout)
    elif how == 4 and values.ndim:
        file.create_dataset(name, data=values, compression="gzip")
    else:
        file[name] = file["/"]


def _change_attribute(file: h5py.File, groups: list[str], case: Case) -> None:
    what, place, *rest = case
    known = [(group, name) for group in groups for name in file[group or "/"].attrs]
    if what == "json":
        known = [pair for pair in known if pair[1] in ("record", "configuration")]
        group, name = known[0]
        form = json.loads(file.attrs[name])
        nodes = list(_nodes(form))
        holder, key = nodes[rest[0] % len(nodes)]
        holder[key] = rest[1]
        file.attrs[name] = json.dumps(form)
        return
    group, name = known[place % len(known)]
    if rest[0] is None:
        del file[group or "/"].attrs[name]
    else:
        file[group or "/"].attrs[name] = rest[0]


def _nodes(form: Any) -> Iterator[tuple[Any, Any]]:
    for key, value in form.items() if isinstance(form, dict) else enumerate(form):
        yield form, key
        if isinstance(value, dict | list):
            yield from _nodes(value)


# ---- judging ----


def _refusal(error: BaseException, path: Path) -> tuple[str, str]:
    said = str(error)
    if not isinstance(error, FileFormatError | FileNotFoundError):
        return "traceback", f"{type(error).__name__}: {said[:300]}"
    return ("refused" if "\n" not in said and str(path) in said and len(said) < 800 else "wordy"), said[:300]


def file_judge(name: str, load: Callable[[Path], Any], *, sealed: bool = True) -> Judge:
    """Judge of a kind of file: a sealed one whose bytes were changed must never be accepted."""

    def judge(folder: Path, case: Case) -> tuple[str, str]:
        source, path = folder / name, folder / f"mutant-{os.getpid()}-{name}"
        how, mutation = case
        before = source.read_bytes()
        if how == "hdf5":
            path.write_bytes(before)
            mutate_hdf5(path, mutation)
        else:
            path.write_bytes(mutation if how == "whole" else mutate_bytes(before, mutation))
            if how == "forged":
                with path.open("r+b") as file:
                    file.truncate(max(BLOCK, path.stat().st_size))
                seal(path)
        changed = path.read_bytes() != before
        try:
            load(path)
        except Exception as error:
            return _refusal(error, path)
        return ("lie" if sealed and how == "bytes" and changed else "accepted"), ""

    return judge


def _show(command: Callable[[Path, bool], None]) -> Callable[[Path], Any]:
    """The command that prints a file: what it prints is part of what may go wrong."""

    def show(path: Path) -> None:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            command(path, False)
            command(path, True)

    return show


def _load_net(path: Path) -> Any:
    from gmem_jax.reading import training

    return training.load(path)


def _load_waves(path: Path) -> Any:
    load_target(path)
    return gm.load_waveforms(path)


_WORDS = st.one_of(
    st.sampled_from(
        [
            "nan",
            "inf",
            "-inf",
            "-1",
            "0",
            "1",
            "2",
            "0.5",
            "1e308",
            "-1e308",
            "1e-320",
            "9" * 400,
            "0x10",
            "1_0",
            "\uff11\uff12",
        ]
    ),
    st.sampled_from(
        ["", " ", "-", "--", "---", "=", "null", "None", "True", "\x00", "\ud800", "[/x]", "%s", "{0}", "é"]
    ),
    st.sampled_from(
        ["six", "words:0", "words:3", "words:99999", "words:", "hooke", "M2", "m1", "frictionless", "sub2"]
    ),
    st.sampled_from(["pack.h5", "recall.h5", "old-pack.h5", "part.npz", "net.msgpack", "waves.csv", "waves.npy"]),
    st.sampled_from(["folder", "pipe.h5", "pipe.csv", ".", "..", "/", "/dev/null", "/dev/zero", "nowhere/x.h5"]),
    st.sampled_from(
        ["tetra-325-a", "tetra-325-a,tetra-325-b", ",", "out.h5", "out.json", "out.csv", "x" * 300 + ".h5"]
    ),
    st.sampled_from(["mu=0.5:2", "mu=2:1", "mu=nan:1", "gamma0=1:2", "=:", "1,8", "1,x", "H,M1", "--help", "--json"]),
    st.text(max_size=6),
)
_NUMBERS = st.one_of(_NASTY.map(repr), st.floats().map(repr), st.integers().map(str), st.floats(0.0, 1.0).map(str))
_COUNTS = st.one_of(st.integers(-2, 40).map(str), st.integers().map(str), st.sampled_from(["1e3", "9" * 30, "-0"]))
_VALUES = {"float": _NUMBERS, "int": _COUNTS, "bool": st.just("")}


def _kind_of(entry: Any) -> str:
    """What values an option takes: the word of `_VALUES` that its type names first."""
    said = str(getattr(getattr(entry, "type_descriptor", None), "annotation", ""))
    return next((kind for kind in _VALUES if kind in said), "text")


_COMMANDS: dict[str, list[tuple[str, str]]] = {  # options and the kind of their value
    name: sorted(
        (option, _kind_of(entry))
        for entry in app.command_named(name).params
        for option in entry.opts
        if option.startswith("-")
    )
    for name in app.typer.main.get_command(app.app).commands  # type: ignore[attr-defined]
}
_FIRST = {"recall": "pack.h5", "show": "recall.h5", "classify": "recall.h5", "prepare": "-o"}


@st.composite
def _lines(draw: st.DrawFn) -> Case:
    """A command line: mostly a command, its argument and a few of its options, mostly with values."""
    command = draw(st.sampled_from([*_COMMANDS, "sing", ""]))
    line = [command] if command else []
    if draw(st.integers(0, 3)):
        line += [_FIRST.get(command, "pack.h5")] if command not in ("info", "demo", "bench", "prepare") else []
    for option, kind in draw(st.lists(st.sampled_from(_COMMANDS.get(command, [("--mu", "float")])), max_size=4)):
        value = draw(_VALUES.get(kind, _WORDS) if draw(st.integers(0, 7)) else _WORDS)
        line += [option, value] if value else [option]
    line += [draw(_WORDS)] if not draw(st.integers(0, 5)) else []
    return tuple(line)


def _stop(*_: Any, **__: Any) -> Any:
    raise gm.RunFailedError("what takes long is not run here")


def _without_runs() -> None:
    """Every command up to where it would compute."""
    from gmem_jax.bench import measure
    from gmem_jax.command import sweep
    from gmem_jax.design import by_kernel, waveforms
    from gmem_jax.reading import training

    recalls.run = packs.prepare = measure.run_benchmark = training.train_net = _stop  # type: ignore[assignment]
    sweep.SweepRunner.run = _stop  # type: ignore[method-assign]
    for module, *names in (
        (derive, "value_and_grad", "prefix_of", "memory_kernel", "design_drive"),
        (by_kernel, "design_by_kernel"),
        (waveforms, "design_waveforms"),
    ):
        for name in names:
            assert hasattr(module, name), name
            setattr(module, name, _stop)


def spoken(line: Sequence[str]) -> tuple[Any, str, str]:
    """Exit code of a command line that is run in this process, and what it wrote to stdout and stderr."""
    sys.argv = ["gmem", *line]
    out, err = io.StringIO(), io.StringIO()
    code: Any = 0
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            app.main()
    except SystemExit as stop:
        code = stop.code or 0
    return code, out.getvalue(), err.getvalue()


def judge_line(folder: Path, case: Case) -> tuple[str, str]:
    """Run a command line in this process, as the entry point does."""
    _without_runs()
    work = folder / f"work-{os.getpid()}"
    if not work.exists():
        shutil.copytree(folder, work, ignore=shutil.ignore_patterns("work-*", "mutant-*", "pipe.*"))
        for pipe in ("pipe.h5", "pipe.csv"):
            os.mkfifo(work / pipe)
    os.chdir(work)
    try:
        code, out, err = spoken(case)
    except BaseException as error:
        return "traceback", f"{type(error).__name__}: {str(error)[:300]}"
    said = [line for line in err.splitlines() if line.strip() and not line.startswith("warning:")]
    if code == 2 and (len(said) != 1 or out):
        return "wordy", f"{len(said)} lines: {err[:300]!r}"
    return ("accepted" if code in (0, 1) else "refused"), f"exit {code}"


def _of(how: str, cases: st.SearchStrategy[Case]) -> st.SearchStrategy[Case]:
    return st.tuples(st.just(how), cases)


_RAW, _FORGED, _INSIDE = _of("bytes", _BYTES), _of("forged", _BYTES), _of("hdf5", _H5)


def _load_sweep(path: Path) -> Any:
    """A sweep file, up to its first computation."""
    return planned(path, read_spec(path), path.parent / f"sweep-{os.getpid()}")


# Lines of a sweep file: some say something, most are wrong somewhere.
_NAMES = st.sampled_from(
    ["mu", "gamma0", "t0", "pack", "signals", "friction", "prepare.seed", "colour", "steps", "points"]
)
_CELLS = st.one_of(
    st.floats().map(repr),
    st.integers(-2, 99).map(str),
    st.sampled_from(['"six"', '"H"', '"tetra-325-a"', "[]", "{}", "1979-05-27"]),
)
_AXES = st.one_of(
    _CELLS,
    st.lists(_CELLS, max_size=4).map(lambda cells: f"[{', '.join(cells)}]"),
    st.tuples(_CELLS, _CELLS, _CELLS).map(lambda cells: "{{from = {}, to = {}, count = {}}}".format(*cells)),
)
_SWEEP = st.lists(
    st.one_of(
        st.sampled_from(["[vary]", "[experiment]", "[prepare]", "[[zip]]", "[[points]]", "[run]", "[odd]"]),
        st.tuples(st.sampled_from(['"mu"', '"prepare.grains"', "mu", "t0"]) | _NAMES.map(json.dumps), _AXES).map(
            " = ".join
        ),
    ),
    max_size=8,
).map(lambda lines: "\n".join(lines).encode())

KINDS: dict[str, Kind] = {
    "packs": Kind(0.25, st.one_of(_RAW, _INSIDE, _INSIDE), file_judge("pack.h5", _show(showing.show))),
    "recalls": Kind(0.21, st.one_of(_RAW, _INSIDE, _INSIDE), file_judge("recall.h5", _show(showing.show))),
    "parts": Kind(0.12, st.one_of(_RAW, _FORGED), file_judge("part.npz", load_part)),
    "nets": Kind(0.10, st.one_of(_RAW, _FORGED), file_judge("net.msgpack", _load_net)),
    "csv": Kind(0.06, _RAW, file_judge("waves.csv", _load_waves, sealed=False)),
    "npy": Kind(0.05, _RAW, file_judge("waves.npy", _load_waves, sealed=False)),
    "sweeps": Kind(0.05, st.one_of(_RAW, _of("whole", _SWEEP)), file_judge("sweep.toml", _load_sweep, sealed=False)),
    "command lines": Kind(0.16, _lines(), judge_line),
}


# ---- running ----


def _patience(seconds: float) -> None:
    signal.setitimer(signal.ITIMER_PROF, seconds)
    signal.setitimer(signal.ITIMER_REAL, 20.0 * seconds)


def _child(folder: Path, kind: Kind, number: int, count: int, pipe: int) -> None:
    """Try `count` cases; outcomes go into the pipe, each after its case."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 2)  # what native code says
    for one in HUNG:
        signal.signal(one, signal.SIG_DFL)
    jax.config.update("jax_enable_x64", True)

    def tell(*what: Any) -> None:
        packed = pickle.dumps(what)
        os.write(pipe, len(packed).to_bytes(4, "little") + packed)

    @seed(number)
    @settings(
        max_examples=count,
        database=None,
        deadline=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(kind.cases)
    def one(case: Case) -> None:
        tell("case", repr(case)[:2000])
        _patience(kind.patience)
        outcome, said = kind.judge(folder, case)
        _patience(0.0)
        tell("outcome", outcome, said)

    one()


def _messages(pipe: int) -> Iterator[tuple[Any, ...]]:
    with os.fdopen(pipe, "rb") as stream:
        while len(head := stream.read(4)) == 4:
            yield pickle.loads(stream.read(int.from_bytes(head, "little")))


def _in_child(work: Callable[[int], None]) -> tuple[list[tuple[Any, ...]], int]:
    """What a child of this process told, and its exit status as of `os.waitpid`."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reader)
        code = 1
        try:
            work(writer)
            code = 0
        finally:
            os._exit(code)
    os.close(writer)
    told = list(_messages(reader))
    return told, os.waitpid(child, 0)[1]


def fuzz(count: int, number: int = 0, kinds: tuple[str, ...] = tuple(KINDS)) -> dict[str, Any]:
    """Try some `count` inputs; how many of which kind ended how, and those that ended badly.

    No backend of JAX may have been started in this process: its children start their own.
    """
    began = time.perf_counter()
    whole = sum(KINDS[name].share for name in kinds)
    table: dict[str, Counter[str]] = {}
    failures: list[dict[str, str]] = []
    seconds: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _, status = _in_child(lambda _: (jax.config.update("jax_enable_x64", True), make_samples(folder))[1])
        if status:
            raise RuntimeError("the samples could not be made")
        for name in kinds:
            kind, tally = KINDS[name], Counter[str]()
            wanted, at = max(1, round(count * kind.share / whole)), time.perf_counter()
            while (left := wanted - tally.total()) > 0:
                number += 1
                told, status = _in_child(lambda pipe: _child(folder, kind, number, min(left, BATCH), pipe))  # noqa: B023
                case = ""
                for what, *rest in told:
                    if what == "case":
                        case = rest[0]
                        continue
                    tally[rest[0]] += 1
                    if rest[0] in BAD:
                        failures.append({"kind": name, "case": case, "outcome": rest[0], "said": rest[1]})
                if os.WIFSIGNALED(status):
                    outcome = "hang" if os.WTERMSIG(status) in HUNG else "crash"
                    tally[outcome] += 1
                    failures.append(
                        {"kind": name, "case": case, "outcome": outcome, "said": f"signal {os.WTERMSIG(status)}"}
                    )
                elif status or not told:
                    raise RuntimeError(f"a child that tried {name} failed by itself; its last case was {case}")
            table[name], seconds[name] = tally, time.perf_counter() - at
    return {
        "inputs": {name: tally.total() for name, tally in table.items()},
        **{word: sum(tally[word] for tally in table.values()) for word in (*GOOD, *BAD)},
        "by_kind": {name: dict(tally) for name, tally in table.items()},
        "seconds_by_kind": seconds,
        "seconds": time.perf_counter() - began,
        "failures": failures,
    }


def main(kinds: tuple[str, ...] = tuple(KINDS), argv: list[str] | None = None) -> int:
    """Entry point, for some kinds of input; 1 if anything ended badly."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("count", type=int, nargs="?", default=10_000, help="inputs in all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", action="append", choices=sorted(kinds), help="only these")
    parser.add_argument("--json", type=Path, help="write the summary there too")
    given_ = parser.parse_args(argv)
    result = fuzz(given_.count, given_.seed, tuple(given_.kind or kinds))
    text = json.dumps(result, indent=1)
    if given_.json:
        given_.json.write_text(text + "\n")
    print(text)
    return int(any(result[word] for word in BAD))


if __name__ == "__main__":
    sys.exit(main())
