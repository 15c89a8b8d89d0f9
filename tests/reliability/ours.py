"""What others have where this package would write, exchanged files, several at once, and sweeps that somebody ends.

python tests/reliability/ours.py --tries 200 --json found.json
"""

import argparse
import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import psutil

import gmem_jax as gm
from gmem_jax.files.checkpoints import Checkpoints, locked
from gmem_jax.files.ours import remove_leftovers
from gmem_jax.reading.lessons import TrainingConfig
from gmem_jax.reading.training import Training, initial, save, train_net
from gmem_jax.sweeps.processes import RUNNER
from gmem_jax.sweeps.spec import Spec, spec_of
from gmem_jax.sweeps.store import Store
from gmem_jax.sweeps.sweep import SweepRunner
from gmem_jax.sweeps.table import rows

PACK = Path(__file__).parents[1] / "data" / "tetra-27.h5"
ENTRY = "from gmem_jax.command.app import main; main()"
SWEEP = f'[experiment]\npack = "{PACK}"\nt0 = 18000\n[vary]\nmu = [0.2, 1.0]\n[run]\nworkers = 2\n'
NAMES = [
    "run.json",
    "sweep.json",
    "one.npz",
    "one.now",
    "job.json",
    "notes.txt",
    ".o.lock",
    ".gmem-mine.tmp",
    "data.h5",
]
INNER = ["jobs", "points", "failed", "packs", "parts", "parts/abc", "workers", "other"]
MARKS = [
    '{"schema": "gmem-parts/0.1", "key": {}}',
    '{"schema": "gmem-sweep/0.1", "shared": {}, "names": [], "points": []}',
]


def _looks(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def _strangers(folder: Path, chance: random.Random) -> None:
    """Files, folders and links of a user, of names like ours; no marker is whole."""
    far = folder / "far"
    far.mkdir()
    target = folder / "target"
    for name in NAMES:
        (far / name).write_text(f"the user's {name}")
    if chance.random() < 0.2:
        target.symlink_to(far)
        return
    target.mkdir()
    for inner in chance.sample(INNER, 3):
        (target / inner).mkdir(parents=True, exist_ok=True)
    for place in [target, *(path for path in target.rglob("*") if path.is_dir())]:
        for name in chance.sample(NAMES, 3):
            if chance.random() < 0.3:
                (place / name).symlink_to(far / name)
            else:
                (place / name).write_text(f"the user's {name}, here")


def deletion(tries: int, chance: random.Random) -> Counter[str]:
    """A user's files where parts, sweeps, locks and leftovers of ours would be."""
    found: Counter[str] = Counter()
    acts: dict[str, Callable[[Path], object]] = {
        "parts": lambda folder: Checkpoints(folder, {"seed": 1})("one", lambda _: np.zeros(1)),
        "parts, --restart": lambda folder: Checkpoints(folder, {"seed": 1}, restart=True).discard(),
        "sweep": lambda folder: (Store(folder).order([]), Store(folder).clear_failures()),
        "sweep, looked at": lambda folder: rows(Store(folder, make=False)),
        "leftovers": lambda folder: remove_leftovers(folder.resolve()),
        "lock": lambda folder: _lock(folder / "o"),
    }
    for number in range(tries):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            _strangers(folder, chance)
            target = folder / "target"
            if number % 4 == 3 and not target.is_symlink():  # ours by its marker; what is in it is not all
                for marker, mark in zip(("run.json", "sweep.json"), MARKS, strict=True):
                    (target / marker).unlink(missing_ok=True)
                    (target / marker).write_text(mark)
            before = _looks(folder)
            kept = {path: text for path, text in before.items() if number % 4 != 3 or _surely_not_ours(Path(path))}
            act = chance.choice(sorted(acts))
            found[f"tried {act}"] += 1
            try:
                acts[act](target)
            except (gm.FileFormatError, OSError):
                found[f"refused {act}"] += 1
            after = _looks(folder)
            if any(after.get(path) != text for path, text in kept.items()):
                found[f"wrong {act}"] += 1
    return found


def _surely_not_ours(path: Path) -> bool:
    return "far" in path.parts or path.name in ("notes.txt", "data.h5", ".o.lock", ".gmem-mine.tmp")


def _lock(path: Path) -> None:
    with locked(path):
        pass


def identity(tries: int, chance: random.Random) -> Counter[str]:
    """Kept files that were given each other's names."""
    found: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        experiment = gm.Experiment(gm.load_pack(PACK), gm.six_signals(), t0=60.0, store=0.1, rest=0.05, hold=0.05)
        gm.sweep(experiment, {"friction.mu": [0.2, 0.6, 1.0]}, folder / "mu")
        for seed in (1, 2):
            for part in ("one", "two"):
                Checkpoints(folder / f"{seed}", {"seed": seed})(part, lambda _: np.zeros(1))
        for seed in (0, 1):
            save(folder / f"net-{seed}", Training(initial(TrainingConfig(2), seed), seed))
        os.environ["XDG_CACHE_HOME"] = f"{folder}/home"
        named = [f"tetra-{grains}-a" for grains in (28, 29)]
        pack = gm.load_pack(PACK)
        (folder / "home" / "gmem_jax" / "packs").mkdir(parents=True)
        for one in named:
            gm.save_pack(folder / "home" / "gmem_jax" / "packs" / f"{one}.h5", replace(pack, name=one))
        seeds = spec_of({"prepare": {"grains": 16}, "vary": {"prepare.seed": [1, 2]}})
        made = SweepRunner(seeds, folder / "made", lambda _: None)
        for job in made.pack_jobs():
            gm.save_pack(made.store.pack_at(job["name"]), replace(pack, name=job["name"]))
        kinds = {
            "packs by name": (sorted(folder.glob("home/*/packs/*")), lambda: [gm.load_pack(one) for one in named]),
            "packs of a sweep": (sorted(folder.glob("made/packs/*")), lambda: _packs_of(seeds, folder / "made")),
            "points": (sorted((folder / "mu" / "points").iterdir()), lambda: rows(Store(folder / "mu", make=False))),
            "parts": (sorted(folder.glob("[12]/*.npz")), lambda: _read_parts(folder)),
            "nets": (sorted(folder.glob("net-*")), lambda: _read_nets(folder)),
        }
        for _ in range(tries):
            kind = chance.choice(sorted(kinds))
            files, read = kinds[kind]
            one, other = chance.sample(files, 2)
            contents = one.read_bytes(), other.read_bytes()
            found[f"tried {kind}"] += 1
            for first, second in (contents[::-1], contents):
                one.write_bytes(first)
                other.write_bytes(second)
                try:
                    read()
                    found[f"wrong {kind}"] += first != contents[0]
                except ValueError:
                    found[f"refused {kind}" if first != contents[0] else f"wrong {kind}"] += 1
    return found


def _packs_of(spec: Spec, folder: Path) -> None:
    runner = SweepRunner(spec, folder, lambda _: None)
    for seed in (1, 2):
        runner.pack_of({"prepare.grains": 16, "prepare.seed": seed})


def _read_parts(folder: Path) -> None:
    for seed in (1, 2):
        for part in ("one", "two"):
            Checkpoints(folder / f"{seed}", {"seed": seed})(part, lambda _: np.zeros(1))


def _read_nets(folder: Path) -> None:
    for seed in (0, 1):
        train_net(TrainingConfig(2), seed, budget=0.0, most_steps=0, checkpoint=folder / f"net-{seed}")


def concurrency(tries: int) -> Counter[str]:
    """Three recalls into one output at once: one writes it, the others say in a line that they do not."""
    found: Counter[str] = Counter()
    options = ["--t0", "60", "--store", "0.1", "--no-picture"]
    for _ in range(tries):
        with tempfile.TemporaryDirectory() as name:
            command = [sys.executable, "-P", "-c", ENTRY, "recall", str(PACK), "-o", f"{name}/o.h5", *options]
            three = [
                subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
                for _ in range(3)
            ]
            said = [(one.communicate()[1], one.returncode) for one in three]
            codes = sorted(code for _, code in said)
            gm.load_recall(Path(name) / "o.h5")
            found["tried recalls"] += 3
            found["refused recalls"] += codes.count(2)
            found["wrong recalls"] += codes != [0, 2, 2] or any("Traceback" in text for text, _ in said)
            found["wrong recalls"] += [path.name for path in Path(name).iterdir()] != ["o.h5"]
    return found


def ended(tries: int, chance: random.Random) -> Counter[str]:
    """Sweeps of two workers that are sent a signal at some moment: none of theirs is at work 20 s later."""
    found: Counter[str] = Counter()
    kinds = [signal.SIGKILL, signal.SIGTERM, signal.SIGHUP, signal.SIGINT]
    for number in range(tries):
        kind = kinds[number % len(kinds)]
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            (folder / "mu.toml").write_text(SWEEP)
            command = [sys.executable, "-P", "-c", ENTRY, "sweep", "mu.toml"]
            sweep_ = subprocess.Popen(command, cwd=folder, stderr=subprocess.DEVNULL)
            while sweep_.poll() is None and not list((folder / "mu" / "workers").glob("worker-1.run")):
                time.sleep(0.1)
            time.sleep(chance.uniform(0.0, 8.0))
            workers = []
            for worker, who in Store(folder / "mu", make=False).records().items():
                with contextlib.suppress(psutil.Error):
                    workers += [psutil.Process(who["pid"])] * (worker != RUNNER)
            if workers and chance.random() < 0.3 and kind == signal.SIGINT:
                workers[0].suspend()
            sweep_.send_signal(kind)
            sweep_.wait()
            found[f"tried {kind.name}"] += 1
            left = psutil.wait_procs(workers, 20.0)[1]
            found[f"wrong {kind.name}"] += bool(left)
            for one in left:
                one.kill()
    return found


def main() -> int:
    """Try all; 0 if nothing was wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tries", type=int, default=400)
    parser.add_argument("--runs", type=int, default=8)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path, required=True)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    jax.config.update("jax_enable_x64", True)
    os.environ.setdefault("GMEM_THREADS", "1")
    chance = random.Random(options.seed)
    found = {
        "deletion": deletion(options.tries, chance),
        "identity": identity(options.tries // 4, chance),
        "concurrency": concurrency(options.runs),
        "processes": ended(options.runs, chance),
    }
    options.json.write_text(json.dumps(found, indent=1))
    wrong = {name: count for one in found.values() for name, count in one.items() if name.startswith("wrong") and count}
    print(json.dumps(found), wrong)
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
