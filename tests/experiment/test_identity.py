"""Whether keys tell a user's own law, waveform and observer apart: by numbers and code, alike in every process."""

import functools
import runpy
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import TETRA_27
from scipy import interpolate

import gmem_jax as gm
from gmem_jax.experiment.identity import identity
from gmem_jax.experiment.record import key_of_run
from gmem_jax.experiment.several import match
from gmem_jax.experiment.stepping import _case

LAW = """
import jax, jax.numpy as jnp
from dataclasses import dataclass
from typing import Any
FACTOR = 2.0
def spring(x):
    return FACTOR * x
@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Law:
    mu: float = 1.0
    table: Any = None
    power = 1.5
    @property
    def stiffness(self):
        return 0.3
    def init(self, contacts, replicas, dtype):
        return jnp.zeros((contacts, 3, replicas), dtype)
    def __call__(self, contact, normal_force, history):
        add = lambda x: x + 1.0
        force = jnp.where(contact.touching, add(spring(history)), 0.0)
        return force, history if "one" in {"one", "two", "three"} else force
"""
PACK = gm.load_pack(TETRA_27)
SIX = gm.six_signals()


def law_of(source: str) -> Any:
    names: dict[str, Any] = {"__name__": "laws"}
    exec(compile(source, "laws.py", "exec"), names)
    return names["Law"]()


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("spring(history)", "2.0 * spring(history)"),
        ("FACTOR = 2.0", "FACTOR = 3.0"),
        ("return FACTOR * x", "return FACTOR / x"),
        ("return 0.3", "return 0.6"),
        ("x + 1.0", "x - 1.0"),
        ("power = 1.5", "power = 2.5"),
        ("mu: float = 1.0", "mu: float = 0.5"),
    ],
)
def test_another_formula_or_number_of_a_law_is_another_law(before: str, after: str) -> None:
    assert before in LAW
    one, other = law_of(LAW), law_of(LAW.replace(before, after))
    assert identity(one) == identity(law_of(LAW + "# of no weight"))
    assert identity(one) != identity(other)
    keys = [key_of_run(gm.Experiment(PACK, SIX, friction=law)) for law in (one, other)]
    assert keys[0] != keys[1]


def test_code_beside_the_package_is_the_users_own() -> None:
    beside = Path(gm.__file__).parent.with_name("gmem_jax_laws.py")
    made = []
    for number in ("1.0", "2.0"):
        names: dict[str, Any] = {"__name__": "gmem_jax_laws"}
        exec(compile(f"def double(x):\n    return {number} * x\n", str(beside), "exec"), names)
        made.append(names["double"])
    assert identity(made[0]) != identity(made[1])


def test_a_large_table_is_told_to_its_last_digit() -> None:
    law, table = law_of(LAW), jnp.full(2000, 0.3)
    one, other = (replace(law, table=(each,)) for each in (table, table.at[1000].add(1e-16)))
    assert repr(one) == repr(other)
    keys = [key_of_run(gm.Experiment(PACK, SIX, friction=each)) for each in (one, other)]
    assert keys[0] != keys[1]


def test_what_other_libraries_wrap_is_looked_into(tmp_path: Path) -> None:
    equinox = pytest.importorskip("equinox")

    def module(factor: float) -> Any:
        class Layer(equinox.Module):
            weight: jax.Array
            activation: Any = jnp.tanh

            def __call__(self, x: jax.Array) -> jax.Array:
                return factor * self.activation(self.weight * x)

        return Layer

    one, other = module(1.0)(jnp.ones(3)), module(2.0)(jnp.ones(3))
    assert identity(one) == identity(module(1.0)(jnp.ones(3)))
    assert identity(one) != identity(other)
    assert identity(one) != identity(replace(one, activation=jnp.sin))
    assert identity(one) != identity(replace(one, weight=jnp.zeros(3)))
    net = equinox.nn.MLP(1, 1, 8, 2, key=jax.random.key(0))
    assert identity(net) != identity(equinox.tree_at(lambda net: net.layers[0].bias, net, jnp.ones(8)))
    assert identity(functools.partial(max, jax.random.key(0))) != identity(functools.partial(max, jax.random.key(1)))
    assert identity(np.dtype("f4")) != identity(np.dtype("f8"))
    # A spline of scipy, and a function of a module that lies beside.
    splines = [interpolate.CubicSpline([0.0, 1.0, 2.0], [0.0, 1.0, top]) for top in (2.0, 3.0)]
    assert identity(splines[0]) != identity(splines[1])
    found = []
    for factor in (1, 2):
        (tmp_path / "springs.py").write_text(f"def spring(x):\n    return {factor} * x\n")
        springs = runpy.run_path(str(tmp_path / "springs.py"))
        beside = ModuleType("springs")
        vars(beside).update(springs)
        names: dict[str, Any] = {"springs": beside, "__name__": "laws"}
        exec("def force(x):\n    return springs.spring(x)", names)
        found.append(identity(names["force"]))
    assert found[0] != found[1]


HELD = {
    "what a decorator adds": """
import functools
def scaled(f):
    @functools.wraps(f)
    def inner(self, x):
        return K * f(self, x)
    return inner
class Own:
    @scaled
    def __call__(self, x):
        return x
one = Own()""",
    "a named tuple": """
from typing import NamedTuple
class Own(NamedTuple):
    amplitude: float
    def shear(self, u):
        return K * u
one = Own(1.0)""",
    "a kind of number": """
class Own(float):
    def __mul__(self, other):
        return K * float(self) * other
one = {"factor": Own(1.0)}""",
    "a choice": """
from enum import Enum
class Own(Enum):
    FIRST = 1
    def force(self, x):
        return K * x
one = [Own.FIRST]""",
    "an operator": """
class Own:
    def __mul__(self, other):
        return K * other
class Law:
    own = Own()
    def __call__(self, x):
        return self.own * x
one = Law()""",
    "a derivative of its own": """
import jax
@jax.custom_jvp
def one(x):
    return x
@one.defjvp
def one_jvp(x, dx):
    return x[0], K * dx[0]""",
}


@pytest.mark.parametrize("source", HELD.values(), ids=HELD)
def test_what_holds_or_wraps_the_code_of_the_users_own_is_told_by_it(source: str) -> None:
    def made(k: str) -> str:
        names: dict[str, Any] = {"__name__": "laws"}
        exec(compile(source.replace("K", k), "laws.py", "exec"), names)
        return identity(names["one"])

    assert made("2.0") == made("2.0")
    assert made("2.0") != made("3.0")


@pytest.mark.parametrize("called", ["lab.helpers.k(x)", "helpers_of_lab(x)", "lab.helpers.lab.helpers.k(x)"])
def test_code_of_modules_in_packages_is_seen(tmp_path: Path, called: str) -> None:
    (tmp_path / "lab").mkdir()
    (tmp_path / "lab" / "__init__.py").touch()
    (tmp_path / "laws.py").write_text(
        "import lab.helpers\ndef force(x):\n    from lab.helpers import k as helpers_of_lab\n    return " + called
    )
    say = "import laws; from gmem_jax.experiment.identity import identity; print(identity(laws.force))"
    found = []
    for factor in (1, 1, 20):  # of another length, so that what is compiled of the file is made anew
        (tmp_path / "lab" / "helpers.py").write_text(f"import lab\ndef k(x):\n    return {factor} * x\n")
        found.append(subprocess.run([sys.executable, "-c", say], cwd=tmp_path, capture_output=True, text=True).stdout)
    assert len(found[0]) == 65
    assert found[0] == found[1] != found[2]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Chirps:
    rate: jax.Array

    @property
    def count(self) -> int:
        return len(self.rate)

    def shear(self, u: jax.Array) -> jax.Array:
        return jnp.sin(self.rate * u[..., None])

    def integral(self, u: jax.Array) -> jax.Array:
        return self.shear(u)


class Slower(Chirps):
    def shear(self, u: jax.Array) -> jax.Array:
        return jnp.sin(self.rate * u[..., None] / 2.0)


@dataclass(frozen=True)
class Louder(gm.Bumps):
    def shear(self, u: jax.Array) -> jax.Array:
        return 2.0 * super().shear(u)


jax.tree_util.register_dataclass(Louder, ["amplitudes", "centres", "width"], [], ["form"])


def test_waveforms_of_another_formula_are_others() -> None:
    one, other = Chirps(jnp.asarray([2.0])), Slower(jnp.asarray([2.0]))
    assert identity(one) != identity(other)
    assert identity(one) == identity(Chirps(jnp.asarray([2.0])))
    bumps = [kind(jnp.ones((1, 1)), jnp.full((1, 1), 0.5), 0.2) for kind in (gm.Bumps, Louder)]
    keys = [key_of_run(gm.Experiment(PACK, signals)) for signals in bumps]
    assert keys[0] != keys[1]
    louder = gm.Experiment(PACK, bumps[1])
    assert gm.to_dict(louder)["signals"].keys() == {"kind", "sha256"}
    with pytest.raises(ValueError, match="Louder"):
        gm.from_dict(gm.to_dict(louder), PACK)


def _height(factor: float) -> Callable[..., Any]:
    return lambda simulation, state: factor * jnp.mean(state.grains.position[:, 2], axis=0)


def test_an_observer_that_gives_something_else_is_another() -> None:
    keys = [
        key_of_run(gm.Experiment(PACK, SIX, observe={"x": observer}))
        for observer in (_height(1.0), _height(2.0), jax.jit(_height(1.0)), gm.observables.stress())
    ]
    assert keys[0] == keys[2]
    assert keys[0]["observe"] != keys[1]["observe"] != keys[3]["observe"]
    one, other = (gm.observables.normal_forces([pair]) for pair in ((0, 4), (0, 5)))
    assert identity(one) != identity(other)


def test_stable_steps_of_two_laws_of_one_name_are_not_confused() -> None:
    one, other = law_of(LAW), law_of(LAW.replace("FACTOR = 2.0", "FACTOR = 3.0"))
    cases = [_case(gm.Experiment(PACK, SIX, friction=law))[0] for law in (one, other)]
    assert cases[0] != cases[1]


def test_laws_of_one_name_or_with_other_inner_numbers_do_not_run_side_by_side() -> None:
    """As one run they would all have the law of the first."""
    law, table = law_of(LAW), jnp.ones(3)
    one = gm.Experiment(PACK, SIX, friction=replace(law, table=(table,)))
    assert match(one, gm.replace(one, {"friction.mu": 0.5}))
    other = law_of(LAW.replace("FACTOR = 2.0", "FACTOR = 3.0"))
    assert not match(one, gm.replace(one, friction=replace(other, table=(table,))))
    assert not match(one, gm.replace(one, friction=replace(law, table=(2.0 * table,))))


def test_an_identity_is_that_of_every_process(tmp_path: Path) -> None:
    (tmp_path / "laws.py").write_text(LAW)
    say = "import laws; from gmem_jax.experiment.identity import identity; print(identity(laws.Law()))"
    found = {
        subprocess.run(
            [sys.executable, "-c", say], cwd=tmp_path, env={"PYTHONHASHSEED": seed}, capture_output=True, text=True
        ).stdout
        for seed in ("1", "2")
    }
    assert len(found) == 1
    assert len(found.pop()) == 65
