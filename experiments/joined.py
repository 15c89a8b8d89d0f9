"""Parts of one figure that were run at different times or places, as the whole that one run would have given.

python experiments/joined.py fig14 part.csv part.csv ... -o fig14-paper-t0=5400-packs=1-lengths=3+4-nets=1

Parts are tables that `gmem reproduce` wrote; the whole is a table and a picture, named by its scale. If conditions
occur twice, the first row is taken. From parts of another figure `--only mu=1` takes the rows that belong to this one.
For parts with several t0, `--rates "1,800 to 18,000"` gives the text for the title.
"""

import argparse
from pathlib import Path

from console import in_one_line

from gmem_jax.reproduce import draw
from gmem_jax.reproduce.compare import Compared, Conditions, comparison_rows, read_csv, write_csv
from gmem_jax.reproduce.figures import FIGURES, scale_of


def main() -> None:
    """Read the parts, write and draw the whole."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("figure", choices=[name for name, figure in FIGURES.items() if figure.across])
    parser.add_argument("parts", type=Path, nargs="+")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, help="without a suffix: figure-scale, as reproduce names its files"
    )
    parser.add_argument("--only", metavar="NAME=VALUE", default="", help="rows of the parts that have this condition")
    parser.add_argument("--rates", default="", help="t0 of the parts, where it is not that of the scale")
    arguments = parser.parse_args()
    named, *changes = arguments.output.name.removeprefix(f"{arguments.figure}-").split("-")
    scale = ",".join([named, *changes])
    figure, t0 = FIGURES[arguments.figure], arguments.rates or f"{scale_of(scale).t0:,.0f}"
    name, _, value = arguments.only.partition("=")
    if name and name not in Conditions.__dataclass_fields__:
        parser.error(f"--only: no condition {name!r}; there are {', '.join(Conditions.__dataclass_fields__)}")
    rows: dict[tuple[Conditions, str], Compared] = {}
    for part in arguments.parts:
        try:
            table = read_csv(part)
        except (KeyError, TypeError):
            parser.error(f"{part}: is no table that `gmem reproduce` wrote")
        for row in table:
            if not name or getattr(row.conditions, name) == type(getattr(row.conditions, name))(value):
                rows.setdefault((row.conditions, row.measure), row)
    if not rows:
        parser.error(f"--only: no row has {arguments.only}" if name else "there is no row in the parts")
    ordered = sorted(rows.values(), key=lambda row: [getattr(row.conditions, name) for name in figure.across])
    target = arguments.output.parent / f"{arguments.output.name}.png"
    write_csv(target.with_name(f"{arguments.output.name}.csv"), comparison_rows(ordered))
    draw.draw_comparison(target, ordered, figure.across, f"{figure.title}\n{draw.said_of(ordered, t0)}")


if __name__ == "__main__":
    in_one_line(main)
