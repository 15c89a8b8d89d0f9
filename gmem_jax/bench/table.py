"""Measurements as Markdown: the whole table, and the short one of docs/speed.md."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gmem_jax.files.atomic import atomic


def _find(rows: Sequence[dict[str, Any]], **wanted: Any) -> dict[str, Any] | None:
    return next((row for row in rows if all(row[key] == value for key, value in wanted.items())), None)


def rival_of(rows: Sequence[dict[str, Any]], row: dict[str, Any]) -> dict[str, Any] | None:
    """The fastest LAMMPS row for the same case: one core or MPI ranks; for several replicas also serial runs."""
    same = [r for r in rows if (r["engine"], r["law"], r["grains"]) == ("lammps", row["law"], row["grains"])]
    possible = [r for r in same if row["replicas"] > 1 or r["replicas"] == 1]
    return min(possible, key=lambda r: r["us"]) if possible else None


def _time(row: dict[str, Any]) -> str:
    """The best time, and the worst if there were several, as a text."""
    spread = f" - {row['worst']:.3g}" if row.get("worst", row["us"]) > row["us"] else ""
    return f"{row['us']:.3g}{spread}"


def markdown(result: dict[str, Any], baseline: dict[str, Any] | None = None) -> str:
    """The whole table; with a baseline, every row has the ratio of the baseline's time to its own."""
    commit = (result["commit"] or "unknown")[:9]
    versions = result["versions"]
    lines = [
        f"{result['processor']} ({result['instruction_set']}), float64, jax {versions['jax']}, "
        f"LAMMPS {result['lammps']}, commit {commit}",
        "",
        f"Microseconds of wall time per grain-step, all cores of the machine: best - worst of {result['repeats']} "
        f"repeats, rivals in turn, t0 = {result['t0']:g}. Ratios are of the best.",
        "",
        "| law | N | engine | replicas | us | LAMMPS' best / this | compile, s | baseline / this |",
        "|---|---|---|---|---|---|---|---|",
    ]
    rows = result["rows"]
    old = baseline["rows"] if baseline else []
    for row in sorted(rows, key=lambda r: (r["law"], r["grains"], r["engine"], r["replicas"])):
        theirs = rival_of(rows, row) if row["engine"] != "lammps" else None
        ratio = f"{theirs['us'] / row['us']:.1f}" if theirs else ""
        same = {key: row[key] for key in ("engine", "law", "grains", "replicas")}
        before = _find(old, **same, **({"note": row["note"]} if row["engine"] == "lammps" else {}))
        then = f"{before['us'] / row['us']:.2f}" if before else ""
        engine = f"LAMMPS, {row['note']}" if row["engine"] == "lammps" else row["engine"]
        lines.append(
            f"| {row['law']} | {row['grains']} | {engine} | {row['replicas']} | {_time(row)} | {ratio} "
            f"| {row['compile_s']:.1f} | {then} |"
        )
    if growth := result["growth"]:
        lines += ["", "Cost against size (law H; copies of one pack side by side):", ""]
        lines += ["| N | 1 replica | growth | 8 replicas | growth |", "|---|---|---|---|---|"]
        ones, eights = ([row for row in growth if row["replicas"] == count] for count in (1, 8))
        for one, eight in zip(ones, eights, strict=True):
            lines.append(
                f"| {one['grains']} | {_time(one)} | {one['us'] / ones[0]['us']:.2f} "
                f"| {_time(eight)} | {eight['us'] / eights[0]['us']:.2f} |"
            )
    if use := result["bytes_per_grain_replica"]:
        lines += [
            "",
            f"Memory per grain and replica: {', '.join(f'{law} {b / 1e3:.2f} kB' for law, b in use.items())}.",
        ]
    if gradient := result.get("gradient"):
        lines += [
            "",
            f"Gradient of F by 6 x 32 waveform values, whole experiment, N = {gradient['grains']}, "
            f"t0 = {gradient['t0']:g}, commit {(gradient['commit'] or 'unknown')[:9]}: "
            f"{gradient['gradient_s']:.1f} s, one forward run {gradient['forward_s']:.1f} s, "
            f"ratio {gradient['gradient_s'] / gradient['forward_s']:.1f}; peak memory of the process "
            f"{gradient['gradient_bytes'] / 1e9:.2f} GB, {gradient['forward_bytes'] / 1e9:.2f} GB before.",
        ]
    return "\n".join([*lines, ""])


def short(result: dict[str, Any], law: str = "H") -> str:
    """The short table, with a line for each N: every number of replicas beside the fastest LAMMPS rows."""
    rows = [row for row in result["rows"] if row["law"] == law]
    counts = sorted({row["replicas"] for row in rows if row["engine"] == "native"})
    title = " | ".join(f"{count} replica{'s' * (count > 1)}" for count in counts)
    lines = [f"| N | {title} | LAMMPS, best way | ratios |", "|---" * (len(counts) + 3) + "|"]
    for grains in sorted({row["grains"] for row in rows}):
        ours = [_find(rows, engine="native", grains=grains, replicas=count) for count in counts]
        pairs = [(row, theirs) for row in ours if row and (theirs := rival_of(rows, row))]
        best = sorted({(theirs["us"], theirs["note"].split(",")[0]) for _, theirs in pairs})
        cells = [
            f"{grains:,}",
            *(_time(row) if row else "" for row in ours),
            "; ".join(f"{us:.3g} ({note})" for us, note in best),
            " / ".join(f"{theirs['us'] / row['us']:.1f}" for row, theirs in pairs),
        ]
        lines.append(f"| {' | '.join(cells)} |")
    where = f"{result['processor']} ({result['instruction_set']}), commit {(result['commit'] or 'unknown')[:9]}"
    return "\n".join(
        [*lines, "", f"{where}; t0 = {result['t0']:g}; best - worst of {result['repeats']} repeats in turn.", ""]
    )


def into(text: str, made: str, by: str = "benchmarks/short_table.py") -> str:
    """A page in which the text between the marks of a program is replaced by `made`.

    Raises:
        ValueError: if the page has no marks.
    """
    first, last = f"<!-- made by {by} -->", "<!-- end -->"
    before, begin, rest = text.partition(first)
    _, end, after = rest.partition(last)
    if not (begin and end):
        raise ValueError(f"no place between {first} and {last}")
    return f"{before}{begin}\n{made}{end}{after}"


def save_benchmark(folder: Path, result: dict[str, Any], text: str) -> None:
    """Write bench.json and bench.md to `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in (("bench.json", json.dumps(result, indent=1) + "\n"), ("bench.md", text)):
        with atomic(folder / name) as path:
            path.write_text(content, encoding="utf-8")
