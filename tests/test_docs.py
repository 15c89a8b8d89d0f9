"""The pages: links, commands, names and examples are right. Whether the site builds is for `make docs` to say."""

import ast
import importlib.util
import pkgutil
import re
import runpy
import shlex
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import pytest
import typer

import gmem_jax as gm
from gmem_jax.command.app import app, command_named
from gmem_jax.command.sweep import planned
from gmem_jax.physics.state import WARNINGS
from gmem_jax.sweeps.spec import read_spec

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted([*ROOT.glob("*.md"), *DOCS.rglob("*.md"), *ROOT.glob("benchmarks/*.md")])
SMALL = ROOT / "tests" / "data" / "tetra-27.h5"
SHORT: dict[str, Any] = {"t0": 75.0, "store": 0.1, "rest": 0.1, "hold": 0.1}


def name(page: Path) -> str:
    """A page's path in the repository."""
    return str(page.relative_to(ROOT))


def blocks(page: Path, language: str) -> list[str]:
    """The fenced blocks of a page."""
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)


def commands(page: Path) -> list[list[str]]:
    """The shell commands of a page's indented blocks, as words, a command to a list."""
    lines = re.findall(r"^ {4}((?:gmem|make|python) .*)$", page.read_text(), re.MULTILINE)
    return [shlex.split(part, comments=True) for line in lines for part in line.split("&&")]


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_between_files_lead_somewhere(page: Path) -> None:
    links = re.findall(r"\]\(([^)#\s]+)", re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL))
    gone = [link for link in links if ":" not in link and not (page.parent / link).exists()]
    assert not gone


def hooks() -> Any:
    """What the site does beyond mkdocs."""
    for needed in ("mkdocs", "latex2mathml"):
        pytest.importorskip(needed)
    spec = importlib.util.spec_from_file_location("hooks", DOCS / "hooks.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_formulas_of_the_notebook_are_drawn_and_its_code_is_left_alone() -> None:
    page = SimpleNamespace(file=SimpleNamespace(src_uri="first_recall.ipynb"))
    text = '<p>beside $G E \\delta_0$</p><pre>set(ylabel="$p_x$ (Pa)", title="$I$")</pre><p>$t_c$</p>'
    drawn = hooks().on_page_content(text, page=page)
    assert drawn.count("<math") == 2
    assert '<pre>set(ylabel="$p_x$ (Pa)", title="$I$")</pre>' in drawn
    assert "\\delta" not in drawn


def test_the_search_finds_its_index_in_pages_that_are_files(tmp_path: Path) -> None:
    (tmp_path / "search").mkdir()
    (tmp_path / "search" / "search_index.json").write_text('{"docs": []}')
    hooks().on_post_build(SimpleNamespace(site_dir=tmp_path))
    assert (tmp_path / "search" / "search_index.js").read_text() == 'var __index = {"docs": []}'
    assert re.search(r"polyfills: \[(.*)\]", (ROOT / "mkdocs.yml").read_text())[1] == "javascripts/search_from_files.js"  # type: ignore[index]


def test_no_page_stands_twice_in_the_site() -> None:
    nav = (ROOT / "mkdocs.yml").read_text().partition("\nnav:")[2]
    pages = re.findall(r": (\S+\.(?:md|ipynb))$", nav, re.MULTILINE)
    assert len(pages) == len(set(pages)) > 30


def test_no_formula_has_a_root_over_a_fraction() -> None:
    """Browsers without a font for formulas do not stretch it."""
    assert not [page for page in PAGES if r"\sqrt{\frac" in page.read_text()]


@pytest.mark.parametrize("source", ["gmem_jax", "tests", "experiments", "benchmarks", "Makefile"])
def test_pages_that_the_code_names_are_there(source: str) -> None:
    path = ROOT / source
    files = [path] if path.is_file() else [one for one in path.rglob("*") if one.suffix in (".py", ".h", ".cc", ".cu")]
    named = {page for file in files for page in re.findall(r"\bdocs/[\w/]+\.md", file.read_text())}
    assert not [page for page in named if not (ROOT / page).is_file()]


@pytest.mark.parametrize("file", [*map(name, PAGES), "Makefile", "pyproject.toml", ".ci/run"])
def test_tests_that_are_named_are_there(file: str) -> None:
    named = re.findall(r"\btests/[\w/]+(?:\.\w+)?", (ROOT / file).read_text())
    assert not [one for one in named if not (ROOT / one).exists()]


ROOT_COMMAND: Any = typer.main.get_command(app)
COMMANDS = {name: command_named(name) for name in ROOT_COMMAND.commands}


def parsed(words: list[str]) -> dict[str, Any]:
    """What a command of gmem is told, parsed as the command line would; nothing is run.

    Raises:
        Exception: of typer, if there is no such command or option.
    """
    told: dict[str, Any] = COMMANDS[words[1]].make_context(words[1], words[2:]).params
    return told


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_commands_are_there_with_the_options_that_pages_give_them(page: Path) -> None:
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for words in commands(page):
        if words[0] == "make":
            assert {word for word in words[1:] if "=" not in word} <= set(targets), words
        elif words[0] == "python" and words[1] != "-m":
            assert (ROOT / words[1]).is_file(), words
        elif words[0] == "gmem":
            parsed(words)
    for told in re.findall(r"`gmem ([^`]+)`", page.read_text()):  # in a sentence, where arguments may be missing
        command, *words = shlex.split(told)
        if command.startswith("-"):
            command, words = "", [command, *words]
        options = {
            option
            for one in (COMMANDS[command] if command else ROOT_COMMAND).params
            for option in [*one.opts, *one.secondary_opts]
        }
        assert {word for word in words if word.startswith("-")} <= {*options, "--help"}, told


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_a_page_can_be_done_word_for_word_with_no_output_in_the_way_of_another(page: Path) -> None:
    given = [parsed(words).get("output") for words in commands(page) if words[0] == "gmem" and "--force" not in words]
    outputs = [str(output) for output in given if output and Path(output).suffix]
    written = re.findall(r"""save\w*\("([^"]+)""", "".join(blocks(page, "python")))
    assert sorted({*outputs, *written}) == sorted([*outputs, *set(written)])


def test_the_options_of_an_experiment_on_the_page_are_those_of_today() -> None:
    page = runpy.run_path(str(DOCS / "make" / "options_page.py"))["page"]()
    assert page == (DOCS / "howto" / "command_line.md").read_text(), "python docs/make/options_page.py"


def test_a_command_that_is_not_there_is_noticed() -> None:
    with pytest.raises(KeyError):
        parsed(["gmem", "remember"])
    with pytest.raises(Exception, match="--muu"):
        parsed(["gmem", "recall", "pack.h5", "--muu", "1"])


def test_words_that_commands_print_are_explained() -> None:
    glossary, trust = ((DOCS / page).read_text() for page in ("glossary.md", "trust.md"))
    for word in ("Distance", "Asymmetry", "Resolution", "Gain", "Fidelity", "Plug-in, bitwise, Fano"):
        assert re.search(rf"^(\*\*{word}\*\*|\| \${word[0]}\$ \| {word.lower()},)", glossary, re.MULTILINE), word
    assert [bit for bit in gm.Status if bit & WARNINGS and f"\n| `{bit.name}` |" not in trust] == []


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_python_is_python_and_names_of_the_library_are_there(page: Path) -> None:
    for block in blocks(page, "python"):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "gm":
                assert hasattr(gm, node.attr), node.attr


def test_inline_names_of_the_library_are_there() -> None:
    named = {one for page in PAGES for one in re.findall(r"`gm\.(\w+)", page.read_text())}
    assert not [one for one in named if not hasattr(gm, one)]


def test_every_public_name_is_in_the_reference() -> None:
    page = (DOCS / "api.md").read_text()
    shown = set(re.findall(r"^::: gmem_jax\.(\w+)$", page, re.MULTILINE))
    assert shown == set(gm.__all__) - {"capacity", "classify", "protocols"}
    modules = ("reading.capacity", "reading.classify", "experiment.protocols")
    assert all(f"::: gmem_jax.{name}" in page for name in modules)
    assert all(pkgutil.resolve_name(shown) for shown in re.findall(r"^::: (\S+)$", page, re.MULTILINE))


def test_every_record_is_in_the_table_of_contents() -> None:
    listed = re.findall(r"^- \[(.+)\]\((decisions/\w+\.md)#", (DOCS / "decisions.md").read_text(), re.MULTILINE)
    records = [
        (title, f"decisions/{page.name}")
        for page in (DOCS / "decisions").glob("*.md")
        for title in re.findall(r"^## (.+)$", page.read_text(), re.MULTILINE)
    ]
    assert sorted(listed) == sorted(records)


def test_the_readme_is_one_screen() -> None:
    page = (ROOT / "README.md").read_text()
    assert len(page.splitlines()) < 80
    assert len(page.split()) < 600


def test_the_tutorial_needs_no_setting_but_double_precision() -> None:
    first = blocks(DOCS / "tutorial.md", "python")[0]
    assert "jax_enable_x64" in first
    assert jax.config.jax_enable_x64


def test_sweeps_and_protocols_that_pages_write_down_could_be_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    written = [block for page in PAGES for block in blocks(page, "toml")]
    alone = [block for block in written if re.search(r"^\[\[stage\]\]", block, re.MULTILINE)]
    assert len(written) > len(alone) + 1 > 1
    for block in alone:
        path = Path(re.match(r"# (\w+\.toml)\n", block)[1])  # type: ignore[index]
        path.write_text(block)
        assert gm.load_protocol(path).reads
    for block in (block for block in written if block not in alone):
        path = Path("sweep.toml")
        path.write_text(block)
        planned(path, read_spec(path), tmp_path / "sweep")


def test_the_protocol_of_the_tutorial_is_the_same_in_toml(tmp_path: Path) -> None:
    page, (path, names) = DOCS / "tutorial_protocols.md", (tmp_path / "mine.toml", {"gm": gm})
    path.write_text(blocks(page, "toml")[0])
    made = re.search(r"^protocol = (gm.Protocol\(.*?^\))", blocks(page, "python")[0], re.DOTALL | re.MULTILINE)
    assert eval(made[1], names) == gm.load_protocol(path)  # type: ignore[index]


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "python")], ids=name)
def test_examples_run(
    page: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, recalled: tuple[gm.Experiment, gm.Recall]
) -> None:
    """All blocks of a page, one after the other, on a pack of 27 grains and a short experiment."""
    imported = set(re.findall(r"^import (\w+)", page.read_text(), re.MULTILINE))
    for needed in ("xarray", *sorted(imported & {"blackjax", "equinox", "optimistix"})):
        pytest.importorskip(needed)
    monkeypatch.chdir(tmp_path)
    gm.save_recall(Path("recall.h5"), recalled[1])  # a page on files reads what `gmem recall` wrote
    small, experiment, train = gm.load_pack(SMALL), gm.Experiment, gm.classify.train
    monkeypatch.setattr(gm, "load_pack", lambda _: small)
    monkeypatch.setattr(gm, "prepare", lambda **_: small)

    def short(*parts: Any, **fields: Any) -> gm.Experiment:
        own = {"t0": SHORT["t0"]} if "protocol" in fields else SHORT
        return experiment(*parts, **{**fields, **own})

    monkeypatch.setattr(gm, "Experiment", short)
    monkeypatch.setattr(gm.classify, "train", lambda *parts, **given: train(*parts, **{**given, "budget": 1.0}))
    names: dict[str, Any] = {"__name__": "example"}
    for number, block in enumerate(blocks(page, "python")):
        exec(compile(block, f"{page.name}, block {number + 1}", "exec"), names)


@pytest.mark.slow
def test_the_notebook_runs(tmp_path: Path) -> None:
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    notebook = nbformat.read(DOCS / "first_recall.ipynb", as_version=4)
    nbclient.NotebookClient(
        notebook, timeout=600, kernel_name="python3", resources={"metadata": {"path": tmp_path}}
    ).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    printed = "".join(output.get("text", "") for output in outputs)  # a kernel flushes where it likes
    assert "mu = 1.0: F = 0.6" in printed
