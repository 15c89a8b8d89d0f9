"""Interactive pictures of packs in three dimensions: `gm.view(pack)` in a notebook, and figures of a report."""

import base64
import html
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from string import Template

from gmem_jax.experiment.pack import Pack
from gmem_jax.files.atomic import atomic
from gmem_jax.files.exporters import frames_of_pack
from gmem_jax.physics.material import Material
from gmem_jax.physics.pytree import short_repr
from gmem_jax.show.scene import packed
from gmem_jax.simulation.frames import Frames

HEIGHT = 730  # pixels of a view in a notebook


def web(name: str) -> str:
    """The text of one of the files that go into pages."""
    return (resources.files("gmem_jax") / "show" / "web" / name).read_text(encoding="utf-8")


def page(title: str, body: str, *, three: bool, bare: bool = False) -> str:
    """A whole page.

    Args:
        title: title, as plain text.
        body: content, as HTML.
        three: whether it has 3D views.
        bare: whether the page has nothing but a view.
    """
    head = ""
    if three:
        modules = {"three": "three.module.min.js", "orbit": "OrbitControls.js"}
        inlined = ",".join(f'"{name}":"{_address(web(file))}"' for name, file in modules.items())
        head = f'<script type="importmap">{{"imports":{{{inlined}}}}}</script>'
        body += f'\n<script type="module">{web("view.js")}</script>'
    kind = " bare" if bare else ""
    return Template(web("page.html")).substitute(
        title=html.escape(title), style=web("style.css"), head=head, kind=kind, body=body
    )


def _address(script: str) -> str:
    """A script as a data address, from which a page can import it."""
    return f"data:text/javascript;base64,{base64.b64encode(script.encode()).decode()}"


def figure(name: str, frames: Frames, material: Material = Material()) -> str:
    """The HTML of one 3D view, for a `page` with three.

    Args:
        name: identifier of the view in the page: letters, digits and dashes.
        frames: the frames.
        material: material of the grains, for forces in mN.
    """
    captions = [
        f"{stage}, u = {u:.3f}, t = {time:,.0f} t_c"
        for stage, u, time in zip(frames.stages, frames.u, frames.time, strict=True)
    ]
    return Template(web("view.html")).substitute(name=name, data=packed(frames, captions, material))


@dataclass(frozen=True)
class View:
    """A page with one 3D view; a notebook shows it.

    Attributes:
        html: the page.
    """

    html: str

    __repr__ = short_repr

    def _repr_html_(self) -> str:
        frame = f'width="100%" height="{HEIGHT}" style="border:0"'
        return f'<iframe srcdoc="{html.escape(self.html)}" {frame}></iframe>'

    def save(self, path: str | Path) -> None:
        """Write the page.

        Raises:
            OSError: if it cannot be written.
        """
        with atomic(Path(path)) as temporary:
            temporary.write_text(self.html, encoding="utf-8")


def view(pack: Pack | Frames) -> View:
    """An interactive 3D picture of a pack at rest, or of the frames of a recall, to be turned, cut and coloured.

    Args:
        pack: a pack, or `recall.frames`.

    Returns:
        A view that a notebook shows; its method `save(path)` writes it as an HTML page.
    """
    if not isinstance(pack, Pack | Frames):
        kept = "gm.run(experiment, frames=10) keeps frames in recall.frames"
        raise TypeError(f"gm.view takes a gm.Pack or frames, got {type(pack).__name__}; {kept}")
    frames, name = (frames_of_pack(pack), pack.name) if isinstance(pack, Pack) else (pack, "frames")
    return View(page(name, figure("pack", frames), three=True, bare=True))
