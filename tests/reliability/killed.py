"""kill -9 at random moments of every long command, until it has ended: its files must be those of an undisturbed run.

    python tests/reliability/killed.py --kills 100 --json killed.json

Each process is a fork of this one, which has loaded everything and computed nothing; checkpoints are written much more
often than a user's run writes them, so that most kills fall near one.
"""

import argparse
import contextlib
import hashlib
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import psutil

from gmem_jax.command import app
from gmem_jax.files import checkpoints
from gmem_jax.sweeps import work

PACK = str(Path(__file__).parents[1] / "data" / "tetra-27.h5")
SHORT = ["--t0", "150", "--store", "0.2"]
WORDS = ["--signals", "words:3", "--batch", "3", *SHORT, "--no-picture"]
COMMANDS = {
    "prepare": ("pack.h5", ["prepare", "--grains", "20", "--t0", "300", "--seed", "3"]),
    "recall": ("recall.h5", ["recall", PACK, *WORDS]),
    "classify": ("words.json", ["classify", "{recall}", "--seeds", "1", "--nets", "{folder}/nets", "--no-picture"]),
    "gradient": ("gradient.json", ["gradient", PACK, *SHORT, "--no-picture"]),
    "kernel": ("kernel.h5", ["kernel", PACK, "-n", "9", *SHORT, "--no-picture"]),
    "design": ("designed.csv", ["design", PACK, "--iterations", "2", *SHORT, "--no-picture"]),
    "sweep": ("swept", ["sweep", "{folder}/mu.toml"]),
    "tune": ("tuned.json", ["tune", PACK, "--bounds", "mu=0.5:2", "--iterations", "1", *SHORT, "--no-picture"]),
}
SWEEP = f"""[experiment]
pack = "{PACK}"
t0 = 150
store = 0.2
[vary]
mu = [0.2, 0.5, 1.0]
background = ["sub0", "sub2"]
"""
LONGEST = 600.0  # s: a run that takes longer hangs


def start(arguments: list[str], log: Path, first: Callable[[], None] = lambda: None) -> int:
    """A process that runs the command, after it has called `first`."""
    child = os.fork()
    if child:
        return child
    checkpoints.CHECKPOINT_INTERVAL, checkpoints.AT_MILESTONES = 0.2, 0.0
    target = os.open(log, os.O_CREAT | os.O_WRONLY | os.O_APPEND)
    os.dup2(target, 1)
    os.dup2(target, 2)
    sys.argv = ["gmem", *arguments]
    code = 99
    try:
        first()
        app.main()
    except SystemExit as ended:
        code = int(ended.code or 0)
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)


def wait(child: int, limit: float) -> int | None:
    """Its exit code; None if it still runs after `limit` seconds."""
    began = time.monotonic()
    while time.monotonic() - began < limit:
        found, status = os.waitpid(child, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.005)
    return None


def _timeless(value: Any) -> Any:
    """Without how long it took, and where it was written."""
    if isinstance(value, dict):
        return {name: _timeless(item) for name, item in value.items() if name not in ("seconds", "output")}
    return [_timeless(item) for item in value] if isinstance(value, list) else value


def contents(path: Path) -> dict[str, str]:
    """`content` of a file, or of every point of a sweep, by name."""
    files = sorted((path / "points").glob("*.h5")) if path.is_dir() else [path] if path.exists() else []
    return {file.name if path.is_dir() else "": content(file) for file in files}


def content(path: Path) -> str:
    """SHA-256 of all that a file says, but for the time it took to make."""
    said: dict[str, Any] = {}
    if path.suffix == ".h5":
        with h5py.File(path) as file:
            items = {"": file}
            file.visititems(items.__setitem__)
            for name, item in items.items():
                said |= {f"{name}@{key}": str(value) for key, value in item.attrs.items()}
                if isinstance(item, h5py.Dataset):
                    said[name] = item[()].tobytes().hex()
        said["@configuration"] = _timeless(json.loads(said.get("@configuration", "{}")))
    else:
        said = _timeless(json.loads(path.read_text())) if path.suffix == ".json" else {"text": path.read_text()}
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()


def kill_workers(folder: Path) -> int:
    """Kill every worker of a sweep; how many there were."""
    found = 0
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error):
            if work.__name__ in process.cmdline() and str(folder) in process.cmdline():
                process.kill()
                process.wait()
                found += 1
    return found


def chain(name: str, kills: int, folder: Path, chance: random.Random) -> dict[str, Any]:
    """Run a command to its end over and over, killing it on the way, until it was killed so many times."""
    file, arguments = COMMANDS[name]
    fixed = {"folder": folder, "recall": folder / "recall.h5"}
    arguments = [argument.format(**fixed) for argument in arguments]
    output, log = folder / file, folder / f"{name}.log"
    began = time.monotonic()
    code = wait(start([*arguments, "-o", str(output)], log), LONGEST)
    undisturbed = time.monotonic() - began
    assert code == 0, f"{name}: {log.read_text()}"
    wanted = contents(output)
    found = {"kills": 0, "ends": 0, "wrong": [], "undisturbed_seconds": round(undisturbed, 1)}
    target, shortest, began_at = folder / f"killed-{file}", undisturbed, 0.0
    ended = False
    while found["kills"] < kills or not ended:
        fresh, began_at = ended or not found["kills"], time.monotonic()
        child = start([*arguments, "-o", str(target)], log)
        limit = chance.uniform(0.0, shortest) if found["kills"] < kills else LONGEST
        code = wait(child, limit)
        if code is None and name == "sweep" and chance.random() < 0.5 and limit < LONGEST:
            found["kills"] += kill_workers(target)  # the sweep itself goes on, with others
            code = wait(child, LONGEST)
        if code is None:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            kill_workers(target)
            found["kills"] += 1
            found["wrong"] += ["hangs"] if limit == LONGEST else []
        elif code != 0:
            found["wrong"].append(log.read_text()[-300:])
        ended = code == 0
        shortest = min(shortest, time.monotonic() - began_at) if ended and fresh else shortest
        found["ends"] += ended
        there = contents(target)
        if there != wanted if ended else not there.items() <= wanted.items():
            found["wrong"].append(f"another {file} after {found['kills']} kills")
        if ended:
            found["wrong"] += [f"{path.name} is left" for path in folder.glob(f"{target.name}.parts")]
            if found["kills"] < kills:
                shutil.rmtree(target) if target.is_dir() else target.unlink()
        if len(found["wrong"]) > 3:
            break
    return found


def main(argv: list[str] | None = None) -> dict[str, Any]:
    """Kill them all; what was found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=105)
    parser.add_argument("--commands", default=",".join(COMMANDS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(argv)
    names, chance = options.commands.split(","), random.Random(options.seed)
    result = {}
    with tempfile.TemporaryDirectory() as folder:
        os.environ["GMEM_COMPILE_CACHE"] = f"{folder}/programs"
        Path(folder, "mu.toml").write_text(SWEEP)
        if "classify" in names and "recall" not in names:
            wait(start([*COMMANDS["recall"][1], "-o", f"{folder}/recall.h5"], Path(folder) / "log"), LONGEST)
        for name in names:
            result[name] = chain(name, -(-options.kills // len(names)), Path(folder), chance)
            print(name, result[name], flush=True)
    if options.json:
        options.json.write_text(json.dumps(result, indent=1))
    return result


if __name__ == "__main__":
    sys.exit(any(found["wrong"] for found in main().values()))
