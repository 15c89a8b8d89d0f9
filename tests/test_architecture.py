"""How the house is built: imports point downwards only, and importing it starts and loads nothing heavy."""

import ast
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
from scenes import without_settings_of_jax

import gmem_jax

ROOT = Path(gmem_jax.__file__).parent
FLOORS = (
    "errors",
    "home",
    "physics",
    "native",
    "simulation",
    "experiment",
    "files",
    "preparation",
    "sweeps",
    "derivatives",
    "design",
    "reading",
    "show",
    "bench",
    "reproduce",
    "command",
    "__main__",
)


def modules() -> dict[str, Path]:
    """Every module by its dotted name; a package by its own."""
    found = {}
    for path in sorted(ROOT.rglob("*.py")):
        parts = path.relative_to(ROOT.parent).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


MODULES = modules()
LATE = ("import_module", "__import__", "optional")  # imports by a string; the last is that of files.validation
COMPUTED = {  # modules that import by a name that they compute
    "gmem_jax": "public names, by its table",
    "gmem_jax.files.validation": "`optional`, whose calls are looked at",
}


def late_names(tree: ast.AST) -> set[str]:
    """What a module calls the functions that import by a string."""
    names = set(LATE)
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            names |= {alias.asname for alias in node.names if alias.asname and alias.name in LATE}
        elif isinstance(node, ast.Assign) and ast.unparse(node.value).rpartition(".")[2] in LATE:
            names |= {target.id for target in node.targets if isinstance(target, ast.Name)}
    return names


def named(argument: ast.expr | None) -> str | None:
    """The module that a string names, or an f-string the package of; None for what is computed."""
    if isinstance(argument, ast.JoinedStr) and isinstance(argument.values[0], ast.Constant):
        return str(argument.values[0].value).rpartition(".")[0] or None
    whole = isinstance(argument, ast.Constant) and not str(argument.value).startswith(".")
    return str(argument.value) if whole else None  # type: ignore[union-attr]


def imports(name: str, source: str | None = None) -> set[str]:
    """The modules of this package that a module imports anywhere in it: late, for types, and by strings too."""
    found = set()
    tree = ast.parse(MODULES[name].read_text(encoding="utf-8") if source is None else source)
    late = late_names(tree)
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name}: relative import in line {node.lineno}"
            below = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= {one if one in MODULES else str(node.module) for one in below}
        elif isinstance(node, ast.Call) and ast.unparse(node.func).rpartition(".")[2] in late:
            given = [*node.args[:1], *(word.value for word in node.keywords if word.arg == "name")]
            module = named(given[0] if given else None)
            assert module or name in COMPUTED, f"{name}: import of a computed name in line {node.lineno}"
            found.add(module or "")
    return {one for one in found if one.split(".")[0] == ROOT.name}


def floor(name: str) -> int:
    """The number of a module's floor, from below."""
    return FLOORS.index(name.split(".")[1])


def test_the_floors_are_the_folders_there_are() -> None:
    assert {name.split(".")[1] for name in MODULES if "." in name} == set(FLOORS)


@pytest.mark.parametrize("name", [name for name in MODULES if name != ROOT.name])
def test_imports_point_downwards(name: str) -> None:
    above = [one for one in imports(name) if one == ROOT.name or floor(one) > floor(name)]
    assert not above, f"{name} imports {', '.join(sorted(above))}"
    assert all(one in MODULES for one in imports(name))


@pytest.mark.parametrize(
    "planted",
    [
        "importlib.import_module('gmem_jax.command.app')",
        "__import__('gmem_jax.command.app')",
        "optional(name='gmem_jax.command.app', extra='')",
        "from importlib import import_module as load\nload('gmem_jax.command.app')",
        "load = importlib.import_module\nload('gmem_jax.command.app')",
        "import_module(f'gmem_jax.command.{name}')",
        "import_module(f'gmem_jax.{name}')",
    ],
)
def test_an_import_upwards_by_a_string_is_noticed(planted: str) -> None:
    (found,) = imports("gmem_jax.physics.state", planted)
    assert found == ROOT.name or floor(found) > floor("gmem_jax.physics.state")


@pytest.mark.parametrize("planted", ["import_module(name)", "__import__(f'{name}')", "import_module('.app', package)"])
def test_an_import_by_a_computed_name_is_noticed(planted: str) -> None:
    with pytest.raises(AssertionError, match="computed name in line 1"):
        imports("gmem_jax.physics.state", planted)
    for name in COMPUTED:  # none of them is listed in vain
        with pytest.raises(AssertionError, match="computed name"):
            imports("gmem_jax.physics.state", MODULES[name].read_text(encoding="utf-8"))


def test_no_import_goes_in_a_circle() -> None:
    graph = {name: imports(name) - {name} for name in MODULES if name != ROOT.name}
    assert len(list(TopologicalSorter(graph).static_order())) == len(MODULES) - 1  # raises CycleError, which names it


TWICE = {
    "COMMANDS": "every module of commands has its table of them",
    "march": "the steps in plain JAX, and the same in C++",
}


def public_names(source: str) -> list[str]:
    """The functions, classes and variables that a module defines for others."""
    found = []
    for node in ast.parse(source).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.append(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            found += [one.id for target in targets for one in ast.walk(target) if isinstance(one, ast.Name)]
    return sorted({name for name in found if not name.startswith("_")})


def test_a_public_name_is_defined_in_one_module() -> None:
    places: dict[str, list[str]] = {}
    for module, path in MODULES.items():
        for name in public_names(path.read_text(encoding="utf-8")):
            places.setdefault(name, []).append(module)
    assert {name: found for name, found in places.items() if len(found) > 1 and name not in TWICE} == {}
    assert all(len(places[name]) > 1 for name in TWICE)


LOADING = """
import sys
import gmem_jax
from jax._src import xla_bridge
heavy = [name for name in ("flax", "optax", "matplotlib", "plotly", "rich", "jax_md") if name in sys.modules]
from gmem_jax.command.app import app, command_named
from typer.main import get_command
for name in get_command(app).commands:
    command_named(name)
heavy += [name for name in ("scipy", "matplotlib", "jax_md") if name in sys.modules]
print(xla_bridge.backends_are_initialized(), *heavy)
"""


def test_importing_the_package_or_its_command_starts_no_backend_and_loads_nothing_heavy() -> None:
    done = subprocess.run([sys.executable, "-c", LOADING], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False"]


STARTING = """
import sys
import gmem_start
sys.argv = ["gmem", *sys.argv[1].split()]
try:
    gmem_start.main()
except SystemExit:
    slow = ("jax", "numpy", "h5py", "pydantic", "gmem_jax.experiment.experiment")
    sys.stderr.write(" ".join(name for name in slow if name in sys.modules))
"""


@pytest.mark.parametrize(("arguments", "loaded"), [("--help", ""), ("--version", ""), ("info", "")])
def test_what_is_told_at_once_loads_no_more_than_it_needs(arguments: str, loaded: str) -> None:
    told, own = [sys.executable, "-c", STARTING, arguments], without_settings_of_jax()
    done = subprocess.run(told, env=own, capture_output=True, text=True, check=True)
    assert done.stdout
    assert done.stderr == loaded


def text_without_encoding(source: str) -> list[int]:
    """Lines that read or write text in whatever encoding the locale has."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Call):
            continue
        called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        known = any(word.arg == "encoding" for word in node.keywords)
        if called == "read_text":  # whose first argument is the encoding
            known |= bool(node.args)
        elif called == "open":
            modes = [one.value for one in node.args if isinstance(one, ast.Constant) and isinstance(one.value, str)]
            others = isinstance(node.func, ast.Attribute) and len(node.args) > len(modes)  # of an archive or a library
            known |= others or any("b" in mode for mode in modes)
        elif called not in ("write_text", "savetxt"):
            continue
        if not known:
            found.append(node.lineno)
    return found


@pytest.mark.parametrize("name", MODULES)
def test_text_is_utf_8_whatever_the_locale(name: str) -> None:
    assert not text_without_encoding(MODULES[name].read_text(encoding="utf-8"))


def test_text_in_the_locale_s_encoding_is_noticed() -> None:
    bad = ["path.read_text()", "path.write_text(text)", "path.open()", "path.open('w')", "open(path, 'a')"]
    bad += ["np.savetxt(path, values)"]
    good = ["path.read_text('utf-8-sig')", "path.open('rb')", "open(path, 'w', encoding='utf-8')", "archive.open(name)"]
    assert [text_without_encoding(line) for line in (*bad, *good)] == [[1]] * len(bad) + [[]] * len(good)


def test_every_public_name_is_there() -> None:
    for name in gmem_jax.__all__:
        assert getattr(gmem_jax, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'run_memory'"):
        gmem_jax.run_memory  # noqa: B018
