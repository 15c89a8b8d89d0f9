"""The self-contained page of `gmem report`, which shows the content of files."""

import functools
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

from rich.table import Table

from gmem_jax.files.validation import optional
from gmem_jax.physics.state import Status
from gmem_jax.show import render_plotly, tables, view
from gmem_jax.show.figure import Figure
from gmem_jax.show.summaries import GrainView, Part, Summary, summary_of

_CELL = 300  # characters of a value in a configuration
_NUMBER = re.compile(r"[-+]?\d[\d.,e±\s+-]*|nan|-|")
Shown = dict[str, Any]  # the values of a part for the template


@functools.cache
def _template() -> Any:
    jinja2 = optional("jinja2", "report")
    loader = jinja2.FunctionLoader(view.web)
    return jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True).get_template("report.html")


def _safe(html: str) -> Any:
    """HTML of our own, which the template does not escape."""
    return optional("markupsafe", "report").Markup(html)


def _cells(head: Sequence[str], rows: Sequence[Sequence[Any]], caption: str = "") -> Shown:
    """A table for the template; columns of numbers are aligned to the right."""
    cells = [["" if cell is None else str(cell) for cell in row] for row in rows]
    right = [all(_NUMBER.fullmatch(cell) for cell in column) for column in zip(*cells, strict=True)]
    return {"head": head, "rows": cells, "right": right, "caption": caption}


def _of_rich(drawn: Table) -> Shown:
    """A table made for the terminal, for the template."""
    head = [str(column.header) for column in drawn.columns] if drawn.show_header else [""] * len(drawn.columns)
    rows = list(zip(*(map(str, column.cells) for column in drawn.columns), strict=True))
    return {"heading": str(drawn.title or ""), **_cells(head, rows, str(drawn.caption or ""))}


def _configuration(values: Mapping[str, Any]) -> Iterator[Shown]:
    """A folded table of all parameters; long values are cut."""

    def flat(part: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, str]]:
        for name, value in part.items():
            if isinstance(value, dict) and value:
                yield from flat(value, f"{above}{name}.")
            else:
                text = value if isinstance(value, str) else json.dumps(value)
                yield above + name, text if len(text) <= _CELL else f"{text[:_CELL]} ..."

    if rows := list(flat(values)):
        yield {**_cells(["", ""], rows), "heading": f"configuration, {len(rows)} values", "folded": True}


def _but_for_its_pack(configuration: Mapping[str, Any]) -> str:
    """The experiment of a recall as a text, with number and shape of the grains instead of the pack.

    It is the same for recalls that differ only in their packs.
    """
    own = {**configuration["experiment"], "pack": [configuration["grains"], configuration["grain"]["shape"]]}
    return json.dumps(own, sort_keys=True)


class Report:
    """A page that grows: sections of files, one after the other.

    Attributes:
        sections: title and parts of each section.
    """

    def __init__(self) -> None:
        self.sections: list[tuple[str, list[Shown]]] = []
        self._recalls: list[Summary] = []
        self._seen: set[str] = set()  # hashes of the packs that are shown at rest
        self._figures = self._views = 0

    def add(self, source: str) -> None:
        """Add the content of a file, of the folder of a sweep, or of a shipped pack.

        Raises:
            FileNotFoundError: if there is no such file.
            FileFormatError: if it is damaged, or of a kind that no command writes.
        """
        found = summary_of(source)
        if found.csv is not None:  # a recall
            self._recalls.append(found)
        shown: list[Shown] = []
        if text := found.facts.get("status_text"):
            status = Status(found.facts["status"])
            kind = "" if not status else " fatal" if status.fatal else " doubtful"
            shown.append({"text": text, "kind": f"status{kind}"})
        for part in (*(Part(line) for line in found.lines), *found.parts()):
            shown.append({"heading": part.heading, "folded": part.folded} | self._shown(part))
        self.sections.append((found.title, [*shown, *_configuration(found.configuration)]))

    def _shown(self, part: Part) -> Shown:
        content = part.content
        if isinstance(content, str):
            return {"text": content}
        if isinstance(content, Table):
            own = _of_rich(content)
            return own if own["heading"] and not part.heading else {**own, "heading": part.heading}
        if isinstance(content, GrainView):
            return self._grains(content)
        assert isinstance(content, Figure | Mapping)
        self._figures += 1
        return {"html": _safe(render_plotly.html(content, f"figure-{self._figures}"))}

    def _grains(self, content: GrainView) -> Shown:
        if content.pack in self._seen:
            return {"text": "Its pack at rest is shown above."}
        try:
            frames = content.frames()
        except (OSError, ValueError, KeyError) as error:  # the pack of a recall may be gone
            return {"text": f"Its pack is not shown: {' '.join(str(error).split())}"}
        self._seen |= {content.pack} - {""}
        self._views += 1
        return {"html": _safe(view.figure(f"view-{self._views}", frames, content.material))}

    def page(self, title: str) -> str:
        """The whole page."""
        made = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
        body = _template().render(title=title, made=made, sections=[*self._overview(), *self.sections])
        library = f"<script>{render_plotly.script()}</script>\n" if self._figures else ""
        return view.page(title, f"{library}{body}", three=self._views > 0)

    def _overview(self) -> list[tuple[str, list[Shown]]]:
        """A table of the recalls, with means and SD, if they are of one experiment on several packs; else nothing."""
        if len(self._recalls) < 2:
            return []
        configurations = [dict(each.configuration) for each in self._recalls]
        packs = {each.get("experiment", {}).get("pack", {}).get("sha256") for each in configurations}
        if len(packs) < len(configurations) or len(set(map(_but_for_its_pack, configurations))) > 1:
            return []
        rows = [each.facts for each in self._recalls]
        return [("Packs", [_of_rich(tables.recall_table(rows, configurations[-1]))])]
