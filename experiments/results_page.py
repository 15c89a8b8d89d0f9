"""The tables of docs/results/README.md from the files beside it, as `gmem reproduce` wrote them.

python experiments/results_page.py
"""

import csv
import json
from pathlib import Path

HERE = Path(__file__).parent.parent / "docs" / "results"
BEGIN, END = "<!-- made by experiments/results_page.py -->", "<!-- end -->"
ALWAYS = ("measure", "mean", "sd", "packs")


def table(path: Path) -> list[str]:
    """A figure's CSV as Markdown: what varies, ours, the published."""
    with path.open() as file:
        rows = list(csv.DictReader(file))
    names = list(rows[0])
    conditions = names[: names.index("measure")]
    varied = [name for name in conditions if len({row[name] for row in rows}) > 1]
    head = [*varied, "measure", "ours ± SD (packs)", "published ± SD (packs), N", "combined errors apart"]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for row in rows:
        ours = f"{_with(row['mean'], row['sd'])} ({row['packs']})"
        theirs = ""
        if row["published_mean"]:
            theirs = f"{_with(row['published_mean'], row['published_sd'])} ({row['published_packs']}), "
            theirs += f"{int(row['published_grains']):,}"
        apart = f"{float(row['combined_errors_apart']):+.1f}" if row["combined_errors_apart"] else ""
        lines.append(f"| {' | '.join([*(row[name] for name in varied), row['measure'], ours, theirs, apart])} |")
    return lines


def choices(path: Path) -> list[str]:
    """The table of what the paper leaves open as Markdown; defaults in bold."""
    lines = ["| choice | value | G | F | change of G | change of F | packs |", "|---|---|---|---|---|---|---|"]
    with path.open() as file:
        for row in csv.DictReader(file):
            own = [_with(row[name], row[f"{name}_sd"]) for name in ("G", "F")]
            of_gain = f"{100.0 * float(row['dG_over_G']):+.1f} %"
            if row["dG_over_G_sd"]:
                of_gain += f" ± {100.0 * float(row['dG_over_G_sd']):.1f}"
            of_fidelity = f"{float(row['dF']):+.3f}" + (f" ± {float(row['dF_sd']):.3f}" if row["dF_sd"] else "")
            default = row["default"] == "1"
            value = f"**{row['value']}**" if default else row["value"]
            change = ["", ""] if default else [of_gain, of_fidelity]
            lines.append(f"| {' | '.join([row['meaning'], value, *own, *change, row['packs']])} |")
    return lines


def _with(mean: str, deviation: str) -> str:
    return f"{float(mean):.3f}" + (f" ± {float(deviation):.3f}" if deviation else "")


def main() -> None:
    """Put all of them between the marks of the page."""
    lines = []
    for folder in sorted(path for path in HERE.iterdir() if path.is_dir()):
        for path in sorted(folder.glob("claims-*.json")):
            lines += [f"## Claims, {folder.name}", "", "| claim | holds | numbers |", "|---|---|---|"]
            for verdict in json.loads(path.read_text()):
                said = "yes" if verdict["holds"] else "no"
                lines.append(f"| {verdict['claim']} | {said} | {verdict['numbers']} |")
            lines.append("")
        for picture in sorted((*folder.glob("choices-*.png"), *folder.glob("fig*.png"))):
            name, numbers = picture.stem, picture.with_suffix(".csv")
            lines += [f"## {name}", "", f"![{name}]({picture.relative_to(HERE)})", ""]
            if name.startswith("choices"):
                lines += [*choices(numbers), ""]
            elif numbers.is_file():
                lines += [*table(numbers), ""]
    page = HERE / "README.md"
    before, _, rest = page.read_text().partition(BEGIN)
    page.write_text(f"{before}{BEGIN}\n\n" + "\n".join(lines) + f"{END}{rest.partition(END)[2]}")


if __name__ == "__main__":
    main()
