"""The command `gmem report`."""

import time
from pathlib import Path
from typing import Annotated

import typer

from gmem_jax.command.console import AsJson, Force, Output, check_output, log, print_result
from gmem_jax.files.atomic import atomic
from gmem_jax.show.render_plotly import script
from gmem_jax.show.report import Report

Files = Annotated[
    list[str],
    typer.Argument(help="Recalls, packs, kernels, designs, results of classify, gradient or tune, folders of sweeps."),
]


def report_command(
    files: Files, output: Output = Path("report.html"), force: Force = False, as_json: AsJson = False
) -> None:
    """One page of all that files hold, to be looked at in a browser: figures, tables and the pack in 3D; no network."""
    check_output(output, ".html", inputs=tuple(files), force=force)
    began = time.perf_counter()
    script()  # fails at once if plotly is not installed
    report = Report()
    for file in files:
        report.add(file)
    text = report.page(Path(files[0]).name if len(files) == 1 else f"{Path(files[0]).name} and {len(files) - 1} more")
    with atomic(output) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")  # names may be any bytes
    megabytes = len(text) / 1e6
    log(f"wrote {output} ({megabytes:.1f} MB)")
    result = {"output": str(output), "megabytes": megabytes, "sections": [title for title, _ in report.sections]}
    print_result(as_json, {**result, "seconds": time.perf_counter() - began, "status": 0})


COMMANDS = {"report": report_command}
