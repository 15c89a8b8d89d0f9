"""Limits of memory, of open files, of the size of a file and of time, under every long command.

    python tests/reliability/limits.py --json limits.json

It fits, or it is one line; or the system ends it, as it does where the time is over. Then nothing is left where the
output would be, and the same command without a limit goes on.
"""

import argparse
import json
import os
import resource
import sys
import tempfile
import time
from pathlib import Path

from killed import COMMANDS, LONGEST, content, start, wait

LIMITS: dict[str, tuple[int, list[int]]] = {  # what the kernel limits, and to how much
    "memory beside what a start takes (MB)": (resource.RLIMIT_AS, [30, 200, 800]),
    "open files": (resource.RLIMIT_NOFILE, [5, 8, 16]),
    "size of a file (kB)": (resource.RLIMIT_FSIZE, [1, 8, 100]),
    "CPU time (s)": (resource.RLIMIT_CPU, [1, 2]),
}
UNITS = {resource.RLIMIT_AS: 1 << 20, resource.RLIMIT_FSIZE: 1 << 10}
NAMES = ("prepare", "recall", "gradient", "kernel", "design")


def limited(what: int, most: int) -> None:
    """Limit this process."""
    most *= UNITS.get(what, 1)
    if what == resource.RLIMIT_AS:
        most += int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    if what == resource.RLIMIT_CPU:
        most += int(time.process_time())
    resource.setrlimit(what, (most, most))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def tried(name: str, what: int, most: int, folder: Path, sound: str) -> str:
    """How a command ends under a limit: "fitted", "refused", "ended by the system", or "wrong: " and why."""
    suffix, arguments = COMMANDS[name]
    output, log = folder / f"limited-{suffix}", folder / "log"
    log.unlink(missing_ok=True)
    command = [*arguments, "-o", str(output), "--restart"]
    code = wait(start(command, log, lambda: limited(what, most)), LONGEST)
    said = log.read_text(errors="replace")
    lines = [line for line in said.splitlines() if line.startswith("gmem: ")]
    there = output.exists()
    if "Traceback" in said:
        return f"wrong: a traceback, {said[-300:]}"
    if code is None:
        return "wrong: hung"
    if there and content(output) != sound:
        return "wrong: another output"
    if there != (code == 0) or (code > 0 and len(lines) != 1):
        return f"wrong: exit {code}, {'an' if there else 'no'} output, {said[-300:]!r}"
    if code < 0 and (wait(start([*arguments, "-o", str(output)], log), LONGEST) or content(output) != sound):
        return f"wrong: does not go on, {log.read_text()[-300:]!r}"
    output.unlink(missing_ok=True)
    return "fitted" if code == 0 else "refused" if code > 0 else "ended by the system"


def main() -> int:
    """Try all; 0 if nothing was wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--commands", default=",".join(NAMES))
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    result: dict[str, dict[str, int]] = {}
    wrong: list[str] = []
    with tempfile.TemporaryDirectory() as where:
        folder = Path(where)
        os.environ["GMEM_COMPILE_CACHE"] = f"{folder}/programs"
        for name in options.commands.split(","):
            suffix, arguments = COMMANDS[name]
            whole = folder / suffix
            assert wait(start([*arguments, "-o", str(whole)], folder / "log"), LONGEST) == 0, name
            sound = content(whole)
            for limit, (what, amounts) in LIMITS.items():
                for most in amounts:
                    ended = tried(name, what, most, folder, sound)
                    print(f"{name}, {limit} {most}: {ended}", flush=True)
                    kind, _, why = ended.partition(": ")
                    wrong += [f"{name}, {limit} {most}: {why}"] * (kind == "wrong")
                    counts = result.setdefault(limit, {})
                    for word in ("tried", kind):
                        counts[word] = counts.get(word, 0) + 1
    if options.json:
        options.json.write_text(json.dumps({"by_limit": result, "wrong": wrong}, indent=1))
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
