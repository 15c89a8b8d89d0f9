"""Programs that `jax.export` writes, and another process reads that has imported the package and no more."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from scenes import TETRA_27

import gmem_jax as gm

pytest.importorskip("flatbuffers", reason="pip install '.[aot]'")

PACK = TETRA_27
# What the page on exporting says: the library's calls are allowed by name, for JAX promises nothing about them.
CALLS = [jax.export.DisabledSafetyCheck.custom_call(name) for name in gm.native.TARGETS]

ELSEWHERE = """
import sys
import numpy as np
import gmem_jax as gm
import jax
jax.config.update("jax_enable_x64", True)
program = jax.export.deserialize(open(sys.argv[1], "rb").read())
if sys.argv[2] == "number":
    print(repr(float(program.call(np.float64(0.7)))))
else:
    pack = gm.load_pack(sys.argv[3])
    experiment = gm.Experiment(
        pack, gm.words(1), gm.Hooke(mu=0.7), t0=60.0, rest=0.1, hold=0.1, store=0.1, backend=sys.argv[2]
    )
    print(repr(float(program.call(experiment))))
"""


def made(backend: str, mu: float = 0.7) -> gm.Experiment:
    return gm.Experiment(
        gm.load_pack(PACK), gm.words(1), gm.Hooke(mu=mu), t0=60.0, rest=0.1, hold=0.1, store=0.1, backend=backend
    )


def elsewhere(path: Path, exported: jax.export.Exported, what: str) -> float:
    """What the program gives in a fresh process."""
    path.write_bytes(exported.serialize())
    command = [sys.executable, "-c", ELSEWHERE, str(path), what, str(PACK)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, env=os.environ)
    assert done.returncode == 0, done.stderr
    return float(done.stdout)


def test_a_native_program_of_a_number_runs_in_a_process_that_only_imported_the_package(tmp_path: Path) -> None:
    experiment = made("native")

    def fidelity(mu: jax.Array) -> jax.Array:
        return gm.fidelity(gm.replace(experiment, {"friction.mu": mu}))

    exported = jax.export.export(jax.jit(fidelity), disabled_checks=CALLS)(np.float64(0.7))
    expected = float(gm.fidelity(experiment))
    np.testing.assert_allclose(elsewhere(tmp_path / "program", exported, "number"), expected, rtol=1e-9)


@pytest.mark.parametrize("backend", ["native", pytest.param("jax", marks=pytest.mark.slow)])
def test_a_program_of_an_experiment_takes_another_one_elsewhere(tmp_path: Path, backend: str) -> None:
    exported = jax.export.export(jax.jit(gm.fidelity), disabled_checks=CALLS)(made(backend, mu=0.2))
    expected = float(gm.fidelity(made(backend)))
    np.testing.assert_allclose(elsewhere(tmp_path / "program", exported, backend), expected, rtol=1e-9)


def test_a_program_without_the_checks_taken_off_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match="gmem_advance"):
        jax.export.export(jax.jit(gm.fidelity))(made("native"))
