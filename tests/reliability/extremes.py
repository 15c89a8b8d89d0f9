"""Extremes of legal options: runs whose numbers lie at the ends of their intervals, alone and two or three together.

    python tests/reliability/extremes.py 300 --json extremes.json

Every such line must be refused in one line, break with one line that says why, or leave a file that can be read and
whose status says what is doubtful. `lie` is a status of "ok" beside a number that is none, or an F above 1. What would
take long is only estimated, by --dry-run.
"""

import json
import math
import os
import sys
from dataclasses import Field, fields
from pathlib import Path
from typing import Any

import fuzz
from hypothesis import strategies as st

import gmem_jax as gm
from gmem_jax.experiment.experiment import NUMBERS
from gmem_jax.files.configuration import OF_LAW, OF_MATERIAL
from gmem_jax.physics.pytree import Interval
from gmem_jax.preparation.recipe import Recipe

LONG = 3.0  # s: a longer estimate is not run
FAR = ("1e-300", "1e-12", "1e-6", "1e-3", "1e3", "1e6", "1e12", "1e300")
STATIC = {  # numbers whose interval is not in their field
    "dt": ("1e-12", "1e-3", "0.5", "0.8", "0.99", "1"),
    "rest": ("0", "1e-12", "0.004", "3", "1e6"),
    "hold": ("0", "1e-12", "0.004", "3", "1e6"),
    "store": ("0", "1e-12", "0.004", "3", "1e6"),
    "background": ("sub0", "sub2", "sub2-bl"),
    "shear": ("during", "before"),
    "precision": ("mixed",),
}
RECALL = ["recall", str(fuzz.PACK), "--restart", "--no-picture", "--t0", "900", "--store", "0.5"]
PREPARE = ["prepare", "--restart", "--grains", "12", "--t0", "30", "--gas-time", "100", "--piston-gain", "0.02"]
TINY = sys.float_info.min  # what is smaller is zero to processors that flush it


def ends(within: Interval) -> list[str]:
    """Numbers at the ends of an interval, and far out in it."""
    lowest = within.low if within.words.startswith("[") else within.low + max(TINY, math.ulp(within.low))
    highest = within.high if within.words.endswith("]") else math.nextafter(within.high, -math.inf)
    finite = [f"{end!r}" for end in (lowest, highest) if math.isfinite(end) and abs(end) < 1e300]
    return [*finite, *(text for text in FAR if within.holds(float(text)))]


def _options(entries: dict[str, Field[Any]]) -> dict[str, list[str]]:
    found = {name: ends(entry.metadata["interval"]) for name, entry in entries.items() if "interval" in entry.metadata}
    whole = {
        name: [text for text in found[name] if text.isdecimal()]
        for name in ("grains", "seed", "cycles")
        if name in found
    }
    return {f"--{name.replace('_', '-')}": values for name, values in {**found, **whole}.items()}


_OF_RECALL = {
    **_options({**NUMBERS, **OF_LAW, **{name: one for name, one in OF_MATERIAL.items()}}),
    **{f"--{name}": list(values) for name, values in STATIC.items()},
    "--friction": ["H", "M1", "M2", "frictionless"],
    "--signals": ["six", "words:1"],
}
NEEDED = {"--p-max": ["--friction", "M2"], "--creep-fades": ["--creep", "1e-3"]}  # without which it does nothing
_OF_RECIPE = {name: values for name, values in _options({e.name: e for e in fields(Recipe)}).items() if values}


@st.composite
def lines(draw: st.DrawFn, base: list[str], options: dict[str, list[str]]) -> fuzz.Case:
    """A command line with one to three numbers at an end of what is legal."""
    names = draw(st.lists(st.sampled_from(sorted(options)), min_size=1, max_size=3, unique=True))
    line = list(base)
    for name in sorted(names, key=NEEDED.__contains__):
        line += [] if NEEDED.get(name, [name])[0] in line else NEEDED.get(name, [])
        value = draw(st.sampled_from(options[name]))
        if name in line:
            line[line.index(name) + 1] = value
        else:
            line += [name, value]
    return tuple(line)


def judge(folder: Path, case: fuzz.Case) -> tuple[str, str]:
    """Estimate a line, then run it; see the top."""
    try:
        return _judged(folder, case)
    except Exception as error:
        return "traceback", f"{type(error).__name__}: {str(error)[:300]}"


def _judged(folder: Path, case: fuzz.Case) -> tuple[str, str]:
    output = folder / f"extreme-{os.getpid()}.h5"
    output.unlink(missing_ok=True)
    line = [*case, "-o", str(output), "--json"]
    code, out, err = fuzz.spoken([*line, "--dry-run"])
    if code == 0 and not (estimate := json.loads(out)["seconds"]) <= LONG:
        return ("estimated", "") if math.isfinite(estimate) else ("lie", f"{estimate} s")
    code, out, err = fuzz.spoken(line)
    said = [text for text in err.splitlines() if text.startswith("gmem: ")]
    if "Traceback" in err:
        return "traceback", err[-300:]
    if code:
        sound = len(said) == 1 and err.strip().splitlines()[-1] == said[0] and not out and not output.exists()
        return ("refused" if code == 2 else "broke") if sound else "wordy", err[-300:]
    if case[0] == "prepare":
        gm.load_pack(output)
        return "ok", ""
    told = json.loads(out)
    recall, numbers = gm.load_recall(output), (told["gain"], told["fidelity"])
    sound = all(number is not None and math.isfinite(number) for number in numbers) and recall.fidelity <= 1.0
    if told["status"]:
        return "doubtful", told["status_text"]
    return ("ok" if sound else "lie"), str(numbers)


fuzz.KINDS.update(
    {
        "recall": fuzz.Kind(0.85, lines(RECALL, _OF_RECALL), judge, 60.0),
        "prepare": fuzz.Kind(0.15, lines(PREPARE, _OF_RECIPE), judge, 120.0),
    }
)

if __name__ == "__main__":
    sys.exit(fuzz.main(("recall", "prepare")))
