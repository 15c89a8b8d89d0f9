"""A full disk and a read-only one under every long command: one clear line, and earlier files as they were.

    python tests/reliability/disks.py --json disks.json

Needs the right to mount a small tmpfs; says so where there is none.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

PACK = str(Path(__file__).parents[1] / "data" / "tetra-27.h5")
SHORT = ["--t0", "75", "--no-picture"]
ENTRY = "from gmem_jax.command.app import main; main()"
COMMANDS = {
    "prepare": ["prepare", "--grains", "16", "--t0", "75", "-o", "{disk}/pack.h5"],
    "recall": ["recall", PACK, *SHORT, "-o", "{disk}/recall.h5"],
    "gradient": ["gradient", PACK, *SHORT, "-o", "{disk}/gradient.json"],
    "kernel": ["kernel", PACK, "-n", "5", *SHORT, "-o", "{disk}/kernel.h5"],
    "design": ["design", PACK, "--iterations", "1", *SHORT, "-o", "{disk}/designed.csv"],
    "tune": ["tune", PACK, "--bounds", "mu=0.5:2", "--iterations", "1", *SHORT, "-o", "{disk}/tuned.json"],
    "sweep": ["sweep", "{outside}/mu.toml", "-o", "{disk}/swept"],
}
SWEEP = f'[experiment]\npack = "{PACK}"\nt0 = 75\n[vary]\nmu = [0.5, 1.0]\n'
WORDS = ("No space left on device", "Read-only file system", "cannot write there")


@contextmanager
def disk(folder: Path, *, room: int) -> Iterator[Path]:
    """A tmpfs with a file on it and so many bytes left."""
    size = (1 << 20) + room
    subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)], check=True, capture_output=True
    )
    try:
        (folder / "earlier.h5").write_bytes(b"earlier" * (((1 << 20) - (1 << 14)) // 7))
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def tried(name: str, mounted: Path, outside: Path) -> dict[str, Any]:
    """Run a command there; what it said, and what it left."""
    earlier = (mounted / "earlier.h5").read_bytes()
    arguments = [argument.format(disk=mounted, outside=outside) for argument in COMMANDS[name]]
    done = subprocess.run([sys.executable, "-c", ENTRY, *arguments], capture_output=True, text=True, timeout=600)
    last = done.stderr.strip().splitlines()[-1] if done.stderr.strip() else ""
    outputs = [path.name for path in mounted.iterdir() if path.is_file() and path.name != "earlier.h5"]
    sound = (mounted / "earlier.h5").read_bytes() == earlier
    clear = done.returncode == 2 and last.startswith("gmem: ") and any(word in last for word in WORDS)
    whole = done.returncode == 0  # it fitted
    wrong = not sound or not (clear or whole) or (bool(outputs) and not whole) or "Traceback" in done.stderr
    return {"exit": done.returncode, "said": last, "wrong": wrong}


def main(argv: list[str] | None = None) -> dict[str, Any]:
    """Try all; what was found, {} where nothing can be mounted."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(argv)
    result: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as name:
        outside, folder = Path(name), Path(name) / "disk"
        folder.mkdir()
        (outside / "mu.toml").write_text(SWEEP)
        for command in COMMANDS:
            for room in (0, 40_000, 150_000):
                try:
                    with disk(folder, room=room) as mounted:
                        result[f"{command}, {room // 1000} kB left"] = tried(command, mounted, outside)
                except subprocess.CalledProcessError as error:
                    print(f"cannot mount a tmpfs here: {error.stderr.decode().strip()}")
                    return {}
            with disk(folder, room=1 << 22) as mounted:
                subprocess.run(["mount", "-o", "remount,ro", str(mounted)], check=True)
                result[f"{command}, read-only"] = tried(command, mounted, outside)
    for name, found in result.items():
        print(name, found)
    if options.json:
        options.json.write_text(json.dumps(result, indent=1))
    return result


if __name__ == "__main__":
    sys.exit(any(found["wrong"] for found in main().values()))
