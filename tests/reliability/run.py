"""All of it, in under an hour on two cores, and docs/reliability.md with what was found: `make reliability`.

Two pieces run side by side; `--scale`, `--studies` and `--lanes` make it shorter.
"""

import argparse
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import gmem_jax as gm

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
CLUSTER = ROOT / "tests" / "cluster"
PAGE = ROOT / "docs" / "reliability.md"
STUDIES = ["order", "skin", "dt"]

Piece = tuple[str, list[str]]


def pieces(folder: Path, scale: float, studies: list[str]) -> list[Piece]:
    """Name and command of each piece, the longest first; what they find goes into JSON files of their names."""

    def script(path: Path, name: str, *more: object) -> Piece:
        return name, [sys.executable, str(path), *map(str, more), "--json", str(folder / f"{name}.json")]

    sanitizers = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        str(ROOT / "tests/native/test_sanitizers.py"),
    ]
    number = int(time.time()) % 100_000
    slurm = [str(CLUSTER / "one_node.sh"), sys.executable, str(CLUSTER / "sweep_on_slurm.py")]
    return [
        script(HERE / "killed.py", "killed", "--kills", max(8, round(104 * scale))),
        script(HERE / "fuzz.py", "fuzz", max(200, round(10_000 * scale)), "--seed", number),
        script(HERE / "extremes.py", "extremes", max(60, round(400 * scale)), "--seed", number),
        script(HERE / "limits.py", "limits"),
        script(HERE / "disks.py", "disks"),
        script(HERE / "ours.py", "ours", "--tries", max(80, round(800 * scale)), "--runs", max(4, round(16 * scale))),
        ("sanitizers", sanitizers),
        script(ROOT / "benchmarks/trust.py", "trust", "--folder", folder / "trust", "--studies", *studies),
        *([("slurm", [*slurm, "--json", str(folder / "slurm.json")])] if can_have_slurm() else []),
    ]


def can_have_slurm() -> bool:
    """Whether tests/cluster/one_node.sh can start one here."""
    return os.geteuid() == 0 and all(map(shutil.which, ("slurmctld", "slurmd", "munged", "sbatch")))


def run(piece: Piece, folder: Path) -> dict[str, Any]:
    """Run a piece, or read what it found earlier in that folder."""
    name, command = piece
    kept = folder / f"{name}-ended.json"
    if kept.is_file():
        ended: dict[str, Any] = json.loads(kept.read_text())
        return ended
    began = time.perf_counter()
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=environment)
    summary = folder / f"{name}.json"
    content = json.loads(summary.read_text()) if summary.is_file() else {}
    seconds = time.perf_counter() - began
    print(f"{name}: exit {done.returncode} after {seconds:.0f} s", flush=True)
    if done.returncode:
        print(done.stdout[-3000:], done.stderr[-3000:], flush=True)
    ended = {"code": done.returncode, "found": content, "seconds": seconds}
    kept.write_text(json.dumps(ended))
    return ended


def _table(head: Sequence[str], rows: Iterable[Iterable[Any]]) -> list[str]:
    titles, *lines = [f"| {' | '.join(map(str, row))} |" for row in (head, *rows)]
    return [titles, "|---" * len(head) + "|", *lines]


def _kills(found: dict[str, Any]) -> list[str]:
    rows = [(name, one["kills"], one["ends"], len(one["wrong"])) for name, one in found.items()]
    lines = _table(("command", "kills", "runs to the end", "other than undisturbed"), rows)
    total = sum(one["kills"] for one in found.values())
    return [f"{total} kills at random moments.", "", *lines]


def _inputs(found: dict[str, Any]) -> list[str]:
    bad = ("lie", "traceback", "wordy", "hang", "crash")
    words = ("refused", "accepted", *bad)
    by_kind = found["by_kind"]
    rows = [
        (name, count, *(by_kind.get(name, {}).get(word, 0) for word in words))
        for name, count in found["inputs"].items()
    ]
    about = (
        "Refused: one line and exit 2. Accepted: plausible numbers in a file sealed anew, or a "
        "command that came up to its run. Lie: a damaged file that was accepted. Wordy: more than a line."
    )
    return [about, "", *_table(("input", "tried", *words), rows)]


ENDS = {
    "ok": "numbers and a status of ok",
    "doubtful": "a status that says what is doubtful",
    "broke": "broke, with the reason in one line",
    "refused": "refused in one line",
    "estimated": "too long: estimated only",
}


def _extremes(found: dict[str, Any]) -> list[str]:
    bad = ("lie", "traceback", "wordy", "hang", "crash")
    rows = [
        (name, found["inputs"][name], *(one.get(word, 0) for word in ENDS), sum(one.get(word, 0) for word in bad))
        for name, one in found["by_kind"].items()
    ]
    about = (
        "One to three options, each at an end of its interval or far out in it (1e-300 to 1e300), N = 27 and, for "
        "preparations, 12. Wrong: a traceback, more than a line, a file that cannot be read again, or ok beside "
        "numbers that are none."
    )
    return [about, "", *_table(("command", "tried", *ENDS.values(), "wrong"), rows)]


def _limits(found: dict[str, Any]) -> list[str]:
    words = ("tried", "fitted", "refused", "ended by the system", "wrong")
    rows = [(name, *(counts.get(word, 0) for word in words)) for name, counts in found["by_limit"].items()]
    about = (
        "Long commands under `setrlimit`. Refused: one line and no output. Ended by the system, as where the time is "
        "over: nothing is left where the output would be, and the same command without the limit goes on to the same "
        "numbers."
    )
    return [about, "", *_table(("limit of", *words), rows)]


SLURM = {
    "disturbed": "a sweep whose workers are cancelled, and told that their time is over",
    "down": "a sweep whose node goes down, and later the controller",
    "minute": "a run longer than a minute in jobs of a minute",
    "waits": "a job that may begin in an hour",
}


def _slurm(found: dict[str, Any] | None) -> list[str]:
    if found is None:
        return ["Not tried here: it needs root, and Debian's slurm-wlm and munge."]
    told = {name: found.get(name, {"FAILED": 1}).items() for name in SLURM}
    rows = [(about, ", ".join(f"{what}: {count}" for what, count in told[name])) for name, about in SLURM.items()]
    return [
        "`make cluster`: a SLURM of this one machine. All points were compared with those of the same sweep without "
        "SLURM: they are equal, bit for bit.",
        "",
        *_table(("what", "counts"), rows),
    ]


def _disks(found: dict[str, Any]) -> list[str]:
    if not found:
        return ["Not tried: nothing can be mounted here."]
    wrong = [name for name, one in found.items() if one["wrong"]]
    fitted = sum(one["exit"] == 0 for one in found.values())
    refused = len(found) - fitted - len(wrong)
    ends = f"{refused} refused in one line that names the file, {fitted} fitted, {len(wrong)} wrong"
    told = ", ".join(wrong) or "earlier files were intact in all"
    return [f"{len(found)} cases (seven commands; 0, 40 and 150 kB left, and read-only): {ends}: {told}."]


CLASSES = {
    "deletion": "A user's files, folders and links where ours would be, some in a folder with a marker of ours. "
    "Wrong: one was removed or changed.",
    "identity": "Two kept files were given each other's names. Wrong: they were read, or not read once they were back.",
    "concurrency": "Three runs into one output at once. Wrong: not one wrote it, or another said anything but a line.",
    "processes": "Sweeps of two workers that were sent a signal. Wrong: a worker was left after 20 s.",
}


def _ours(found: dict[str, Any]) -> list[str]:
    lines = []
    for kind, about in CLASSES.items():
        counts = found.get(kind, {})
        words = ("tried", "refused", "wrong")
        names = sorted(name.partition(" ")[2] for name in counts if name.startswith("tried "))
        rows = [(name, *(counts.get(f"{word} {name}", 0) for word in words)) for name in names]
        lines += [f"**{kind.capitalize()}.** {about}", "", *_table(("what", *words), rows), ""]
    return lines[:-1]


def _trust(found: list[dict[str, Any]]) -> list[str]:
    rows = [
        (
            row["study"],
            row["value"],
            row["pack"],
            f"{row['G']:.5f}",
            f"{row['F']:.5f}",
            f"{row['away']:.1e}" if row["away"] else "0",
        )
        for row in found
    ]
    lines = _table(("varied", "value", "pack", "G", "F", "p_sig differs by"), rows)
    law = f"with $k_H$ = {gm.Hooke().stiffness:g}"
    return [f"Relative to the first row of the same study and pack, {law}. More in [trust.md](trust.md).", "", *lines]


def page(found: dict[str, dict[str, Any]], minutes: float) -> str:
    """The page."""
    machine = f"{os.cpu_count()} CPUs ({platform.machine()}), Python {platform.python_version()}"
    sound = "passed" if found["sanitizers"]["code"] == 0 else "FAILED"
    parts = {
        "Killed": _kills(found["killed"]["found"]),
        "Hostile input": _inputs(found["fuzz"]["found"]),
        "Extremes of legal options": _extremes(found["extremes"]["found"]),
        "Limits": _limits(found["limits"]["found"]),
        "Full and read-only disks": _disks(found["disks"]["found"]),
        "What is not ours, and what is not itself": _ours(found["ours"]["found"]),
        "SLURM": _slurm(found["slurm"]["found"] if "slurm" in found else None),
        "Native library under sanitizers": [f"ASan, UBSan and TSan over tests/reliability/drive.cc: {sound}."],
        "Numerical trust": _trust(found["trust"]["found"]),
    }
    head = [
        "# Reliability",
        "",
        f"Written by `make reliability` in {minutes:.0f} minutes on {machine}. What the figures mean, and what is not "
        "promised, stands in [decisions.md](decisions.md) and [trust.md](trust.md).",
    ]
    for title, lines in parts.items():
        head += ["", f"## {title}", "", *lines]
    return "\n".join(head) + "\n"


def main() -> int:
    """Run all; 0 if nothing was wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scale", type=float, default=1.0, help="of the numbers of kills and inputs")
    known = [*STUDIES, "builds"] if shutil.which("clang++") else STUDIES
    parser.add_argument("--studies", nargs="+", choices=known, default=known, help="of numerical trust")
    parser.add_argument("--lanes", type=int, default=2, help="pieces side by side")
    parser.add_argument("--folder", type=Path, help="what is found is kept there, and not tried again")
    parser.add_argument("--page", type=Path, default=PAGE)
    options = parser.parse_args()
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(options.lanes) as lanes:
        folder = options.folder or Path(name)
        folder.mkdir(exist_ok=True)
        todo = pieces(folder, options.scale, options.studies)
        ended = lanes.map(lambda piece: run(piece, folder), todo)
        found = {piece: one for (piece, _), one in zip(todo, ended, strict=True)}
    options.page.write_text(page(found, (time.perf_counter() - began) / 60.0))
    print(f"wrote {options.page}")
    return int(any(one["code"] for one in found.values()))


if __name__ == "__main__":
    sys.exit(main())
