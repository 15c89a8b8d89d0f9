"""Double precision everywhere, no programs kept or delayed, which cases run apart, and what many tests read."""

import os
from collections.abc import Iterator
from pathlib import Path

os.environ["GMEM_COMPILE_CACHE"] = "off"  # before the package, which tells its library as soon as it is imported

import jax
import pytest

import gmem_jax as gm

jax.config.update("jax_enable_x64", True)

# Cases of ten seconds and more, nearly all of it compiling, that repeat for a law what their siblings say of others:
# `make test-slow`.
SLOW = (
    "test_both_modes_agree_with_plain_jax[M2-exact-True]",
    "test_both_modes_agree_with_plain_jax[M2-paper-True]",
    "test_both_modes_agree_with_plain_jax[frictionless-True]",
    "test_both_modes_agree_with_plain_jax[H-False]",
    "test_both_modes_of_derivatives_cross_the_domains_as_defined[narrow rings]",
    "test_spinning_sliding_grains_of_several_domains_move_as_defined[1-narrow rings]",
    "test_spinning_sliding_grains_of_several_domains_move_as_defined[9-narrow rings]",
    "test_every_law_and_the_places_of_bumps_and_delta0_have_derivatives[M1]",
    "test_derivatives_are_finite_at_the_corners_of_the_laws[overlap zero-M2]",
    "test_derivatives_are_finite_at_the_corners_of_the_laws[apart-M2]",
    "test_derivatives_are_finite_at_the_corners_of_the_laws[separating so fast that the dashpot would pull-M2]",
    "test_the_kernels_give_the_values_and_tangents_of_the_definition[M1]",
    "test_the_kernels_give_the_values_and_tangents_of_the_definition[frictionless]",
    "test_every_instruction_set_has_the_same_derivatives[avx2]",
    "test_eight_threads_at_once_give_the_bits_of_one_after_the_other[traced-20]",
    "test_a_run_goes_on_with_the_lists_it_had[M2]",
    "test_a_replica_does_not_depend_on_its_neighbours_in_the_batch[chosen1]",
    "test_devices_share_out_replicas_and_sweeps[native-sweep]",
    "test_both_modes_agree_with_plain_jax[M1-True]",
    "test_both_modes_agree_with_plain_jax[M2-averaged-True]",
    "test_every_law_and_the_places_of_bumps_and_delta0_have_derivatives[M2]",
    "test_derivatives_are_finite_at_the_corners_of_the_laws[no sliding-M2]",
    "test_derivatives_are_finite_at_the_corners_of_the_laws[overlap zero-M1]",
    "test_both_modes_of_derivatives_cross_the_domains_as_defined[M2]",
    "test_the_kernels_give_the_values_and_tangents_of_the_definition[M2-averaged]",
    "test_pictures_of_recalls_and_words[fig14]",
    "test_a_run_as_in_the_paper_is_not_doubted[friction2]",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark them."""
    for item in items:
        if item.name in SLOW:
            item.add_marker(pytest.mark.slow)


@pytest.fixture(scope="module", autouse=True)
def few_programs() -> Iterator[None]:
    """Programs are forgotten before they fill the memory maps of a process (65,530 on Linux): XLA crashes there."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_text().count("\n") > 30_000:
        jax.clear_caches()


@pytest.fixture(scope="session")
def recalled() -> tuple[gm.Experiment, gm.Recall]:
    """Two words recalled by 27 grains, far too fast: what tests of files and pictures share."""
    pack = gm.load_pack(Path(__file__).parent / "data" / "tetra-27.h5")
    experiment = gm.Experiment(pack, gm.words(1), t0=75.0, store=0.1, rest=0.1, hold=0.1)
    return experiment, gm.run(experiment)
