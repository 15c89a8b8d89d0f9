"""Pictures that are files, or shown by a notebook. Matplotlib is imported on first use, and no display is asked for."""

import io
import textwrap
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

    def save(self, path: Path) -> None:
        """Write it, in the format of the path's suffix.

        Raises:
            OSError: if it cannot be written.
        """
        path = Path(path)
        with atomic(path) as temporary:
            self.figure.savefig(temporary, format=path.suffix.removeprefix("."), dpi=DPI)

    def title(self, *lines: str) -> None:
        """Put lines over it, broken where the picture ends."""
        width = int(12 * self.figure.get_figwidth())  # letters of this size in an inch
        self.figure.suptitle("\n".join(textwrap.fill(line, width) for line in lines if line), fontsize=9)

    def _repr_png_(self) -> bytes:
        content = io.BytesIO()
        self.figure.savefig(content, format="png", dpi=100)
        return content.getvalue()


def blank(rows: int = 1, columns: int = 1, *, size: tuple[float, float], **shared: Any) -> tuple[Drawing, Any]:
    """A picture of `size` inches, and its axes, [rows, columns]."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    return Drawing(figure), figure.subplots(rows, columns, squeeze=False, **shared)
