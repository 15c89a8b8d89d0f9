"""How far G, F and the recalled signals depend on what they should not depend on.

    python benchmarks/trust.py --folder trust --studies order skin --json trust.json

Each study changes one of these on two packs of 325 grains with six signals: time step, skin of the neighbour list,
duration of a compression, points of M2, order of the grains, compiler and instruction set, backend. Finished runs are
kept in the folder and not repeated. In the study "builds" every run with another library is a process of its own.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

PACKS = ("tetra-325-a", "tetra-325-b")
USUAL = 1.8e3  # t0, in t_c
SHIPPED = "g++ -O3"
# Name of a build: compiler, options instead of -O3, instruction set.
BUILDS = {
    "g++ -O3": ("g++", "-O3", ""),
    "g++ -O2": ("g++", "-O2", ""),
    "clang++ -O3": ("clang++", "-O3", ""),
    "g++ -O3 avx2": ("g++", "-O3", "avx2"),
    "g++ -O3 baseline": ("g++", "-O3", "baseline"),
    "clang++ -O3 baseline": ("clang++", "-O3", "baseline"),
}


class Piece(NamedTuple):
    """One run.

    Attributes:
        study: name of the study.
        label: value of the varied quantity.
        pack: name of the pack.
        changes: fields of the experiment, and other keys that `run_piece` knows; {} for the usual run.
    """

    study: str
    label: str
    pack: str
    changes: dict[str, Any]

    @property
    def file(self) -> str:
        """The file of its result; studies share the usual run."""
        what = "-".join(f"{name}={value}" for name, value in self.changes.items()) or "usual"
        return f"{self.pack}-{what}.npz".replace(" ", "_")


def pieces(studies: list[str]) -> Iterator[Piece]:
    """The runs of some studies, the reference of each study first."""
    values: dict[str, dict[str, dict[str, Any]]] = {
        "order": {"as stored": {}, "shuffled 1": {"order": 1}, "shuffled 2": {"order": 2}},
        "skin": {"0.3": {}, "0.2": {"skin": 0.2}, "0.45": {"skin": 0.45}},
        "builds": {name: {"build": name} if name != SHIPPED else {} for name in BUILDS},
        "t0": {"3600": {"t0": 3600.0}, "1800": {}, "900": {"t0": 900.0}, "360": {"t0": 360.0}},
        "dt": {"0.15": {"dt": 0.15}, "0.3": {"dt": 0.3}, "0.6": {}, "1.2": {"dt": 1.2}},
        "points": {f"{points}": {"points": points, "t0": 360.0} for points in (200, 100, 50)},
        "backends": {name: {"backend": name, "t0": 360.0} for name in ("native", "jax")},
    }
    for study in studies:
        for label, changes in values[study].items():
            yield from (Piece(study, label, pack, changes) for pack in PACKS)


def run_piece(piece: Piece, file: Path) -> None:
    """Do one run, and write G, F, p_sig, status and seconds."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import numpy as np

    import gmem_jax as gm
    from gmem_jax.physics.search import PairFinder
    from gmem_jax.physics.state import Grains
    from gmem_jax.simulation.strain import smallest_box

    changes = dict(piece.changes)
    pack = gm.load_pack(piece.pack)
    if seed := changes.pop("order", 0):
        order = np.random.default_rng(seed).permutation(pack.grains)
        pack = gm.pack_from(pack, position=pack.position[order], quaternion=pack.quaternion[order])
    if skin := changes.pop("skin", None):
        still = np.zeros((pack.grains, 3, 1))
        grains = Grains(pack.position[..., None], pack.quaternion[..., None], still, still, still, still)
        smallest = smallest_box(np.asarray(pack.lower), np.asarray(pack.upper), float(pack.delta0))
        pack = replace(pack, pairs=PairFinder(pack.clump, smallest, skin)(grains, pack.clump, pack.box, smallest))
    law = gm.Mindlin(points=changes.pop("points")) if "points" in changes else gm.Hooke()
    changes.pop("build", None)
    experiment = gm.Experiment(pack, gm.six_signals(), law, **{"t0": USUAL, **changes})
    began = time.perf_counter()
    recall = gm.run(experiment)
    seconds = time.perf_counter() - began
    status = int(np.bitwise_or.reduce(np.asarray(recall.status)))
    np.savez(
        file,
        p_sig=recall.p_sig,
        G=recall.gain,
        F=recall.fidelity,
        F_T1=recall.windowed_fidelity,
        status=status,
        seconds=seconds,
    )


def use_build(name: str, folder: Path) -> None:
    """Let this process load the library of another build, which is compiled if it does not exist."""
    from gmem_jax.native import build
    from gmem_jax.native import library as loaded

    cxx, optimise, instructions = BUILDS[name]
    library = (folder / f"{cxx}{optimise}.so").resolve()
    if not library.exists():
        os.environ["CXX"] = cxx
        build.FLAGS = tuple(optimise if flag == "-O3" else flag for flag in build.FLAGS)
        build.build(library)
    build.source_hash = lambda: ""  # its flags differ on purpose
    loaded.path = lambda: library
    if instructions:
        os.environ["GMEM_ISA"] = instructions


def rows(done: list[tuple[Piece, Path]]) -> list[dict[str, Any]]:
    """The rows of the table: G, F, and the relative distance of p_sig from the study's first run on the same pack."""
    import numpy as np

    reference: dict[tuple[str, str], Any] = {}
    table = []
    for piece, file in done:
        with np.load(file) as found:
            first = reference.setdefault((piece.study, piece.pack), found["p_sig"])
            away = float(np.linalg.norm(found["p_sig"] - first) / np.linalg.norm(first))
            numbers = {name: float(found[name]) for name in ("G", "F", "F_T1", "seconds")}
            table.append(
                {
                    "study": piece.study,
                    "value": piece.label,
                    "pack": piece.pack,
                    **numbers,
                    "away": away,
                    "status": int(found["status"]),
                }
            )
    return table


def main() -> None:
    """Do the missing runs and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    known = ["order", "skin", "builds", "t0", "dt", "points", "backends"]
    parser.add_argument("--studies", nargs="+", choices=known, default=known)
    parser.add_argument("--folder", type=Path, default=Path("trust"), help="where finished runs are kept")
    parser.add_argument("--json", type=Path, help="also write the table here")
    parser.add_argument("--one", help=argparse.SUPPRESS)  # file name of a run to do in this process
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    to_build = [piece for piece in pieces(given.studies) if "build" in piece.changes]
    for compiler in {BUILDS[one.changes["build"]][0] for one in to_build if not (given.folder / one.file).exists()}:
        if shutil.which(compiler) is None:
            parser.error(f"the study builds needs {compiler}, which is not here; name other --studies")
    done = []
    for piece in pieces(given.studies):
        file = given.folder / piece.file
        if given.one not in (None, piece.file):
            continue
        if not file.exists() and "build" in piece.changes and given.one is None:
            again = [sys.executable, __file__, "--studies", piece.study, "--folder", str(given.folder)]
            subprocess.run([*again, "--one", piece.file], check=True, stdout=subprocess.DEVNULL)
        elif not file.exists():
            if "build" in piece.changes:
                use_build(piece.changes["build"], given.folder)
            run_piece(piece, file)
        done.append((piece, file))
        row = rows(done)[-1]
        print(
            "{study:9}{value:22}{pack:13}G {G:.4f}  F {F:.4f}  over T1 {F_T1:.4f}  away {away:.1e}".format(**row),
            flush=True,
        )
    if given.json:
        given.json.write_text(json.dumps(rows(done), indent=1) + "\n")


if __name__ == "__main__":
    main()
