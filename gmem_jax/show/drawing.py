"""Pictures that are files, or shown by a notebook. Matplotlib is imported on first use, and no display is asked for."""

import contextlib
import io
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gmem_jax.files.atomic import atomic

DPI = 130
FORMATS = (".png", ".svg", ".pdf")


@dataclass(frozen=True)
class Drawing:
    """A picture. A notebook shows it; `figure` is matplotlib's, for whoever wants to change it."""

    figure: Any

    def save(self, path: str | Path) -> None:
        """Write it, in the format of the path's suffix.

        Raises:
            OSError: if it cannot be written.
        """
        path = Path(path)
        with atomic(path) as temporary:
            self._write(temporary, format=path.suffix.removeprefix("."), dpi=DPI)

    def title(self, *lines: str) -> None:
        """Put lines over it, broken where the picture ends."""
        width = int(12 * self.figure.get_figwidth())  # letters of this size in an inch
        self.figure.suptitle("\n".join(textwrap.fill(line, width) for line in lines if line), fontsize=9)

    def _repr_png_(self) -> bytes:
        content = io.BytesIO()
        self._write(content, format="png", dpi=100)
        return content.getvalue()

    def _write(self, target: Any, **options: Any) -> None:
        with without_tex(self.figure):
            self.figure.savefig(target, **options)


@contextlib.contextmanager
def without_tex(figure: Any) -> Iterator[None]:
    """Draw a figure by matplotlib alone, whatever the user's matplotlibrc says: LaTeX may not be there."""
    import matplotlib
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        text.set_usetex(False)
    with matplotlib.rc_context({"text.usetex": False}):  # numbers at the axes are made while it is drawn
        yield


def blank(rows: int = 1, columns: int = 1, *, size: tuple[float, float], **shared: Any) -> tuple[Drawing, Any]:
    """A picture of `size` inches, and its axes, [rows, columns]."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    return Drawing(figure), figure.subplots(rows, columns, squeeze=False, **shared)
