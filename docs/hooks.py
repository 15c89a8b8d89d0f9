"""What the site does that mkdocs does not: pages from other folders, and formulas without JavaScript."""

import html
import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parent.parent
MEASURED = ("bench", "paper_rate/bench", "large_packs", "gpu")
FROM_ELSEWHERE = ["CHANGELOG.md", *(f"benchmarks/{name}.md" for name in MEASURED)]
FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)


def on_files(files: Files, config: Any) -> Files:
    """Add pages that are kept beside what they describe."""
    for name in FROM_ELSEWHERE:
        files.append(File.generated(config, name, abs_src_path=str(ROOT / name)))
    return files


def on_page_markdown(text: str, page: Any, **_: Any) -> str:
    """Links between docs/ and benchmarks/, right in the repository, made right in the site."""
    if page.file.src_uri in FROM_ELSEWHERE:
        return text.replace("](../docs/", "](../").replace("](docs/", "](")
    up = "../" * page.file.src_uri.count("/")
    return text.replace(f"]({up}../benchmarks/", f"]({up}benchmarks/")


def on_page_content(text: str, **_: Any) -> str:
    """LaTeX as MathML, which browsers draw by themselves."""
    return FORMULA.sub(_drawn, text)


def _drawn(found: re.Match[str]) -> str:
    display = "block" if found[1] == "div" else "inline"
    return str(convert(html.unescape(found[2]), display=display))
