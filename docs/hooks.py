"""What the site does that mkdocs does not.

Pages from other folders, formulas without JavaScript, and search in pages that are opened as files.
"""

import html
import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parent.parent
FROM_ELSEWHERE = [
    *("CHANGELOG.md", "CONTRIBUTING.md"),
    *sorted(path.relative_to(ROOT).as_posix() for path in (ROOT / "benchmarks").rglob("*.md")),
]
FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)

INLINE = re.compile(r"\$([^$\n]+)\$")
VERBATIM = re.compile(r"(<(?:pre|script|style|textarea)\b.*?</(?:pre|script|style|textarea)>)", re.DOTALL)


def on_files(files: Files, config: Any) -> Files:
    """Add pages that are kept beside what they describe."""
    for name in FROM_ELSEWHERE:
        files.append(File.generated(config, name, abs_src_path=str(ROOT / name)))
    return files


def on_page_markdown(text: str, page: Any, **_: Any) -> str:
    """Links between docs/ and benchmarks/, right in the repository, made right in the site."""
    up = "../" * page.file.src_uri.count("/")
    if page.file.src_uri in FROM_ELSEWHERE:
        return text.replace(f"]({up}docs/", f"]({up}")
    return text.replace(f"]({up}../benchmarks/", f"]({up}benchmarks/")


def on_page_content(text: str, page: Any, **_: Any) -> str:
    """LaTeX as MathML, which browsers draw by themselves."""
    if page.file.src_uri.endswith(".ipynb"):  # its Markdown was not turned by ours
        parts = VERBATIM.split(text)
        parts[::2] = [INLINE.sub(r'<span class="arithmatex">\\(\1\\)</span>', part) for part in parts[::2]]
        text = "".join(parts)
    return FORMULA.sub(_drawn, text)


def on_post_build(config: Any, **_: Any) -> None:
    """The index of the search as a script: the theme asks for it where the pages are files."""
    index = Path(config.site_dir) / "search" / "search_index.json"
    index.with_suffix(".js").write_text(f"var __index = {index.read_text()}")


def _drawn(found: re.Match[str]) -> str:
    display = "block" if found[1] == "div" else "inline"
    formula = str(convert(html.unescape(found[2]), display=display))
    return f'<div class="formula">{formula}</div>' if display == "block" else formula
