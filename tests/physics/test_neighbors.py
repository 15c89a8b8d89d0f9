"""The candidate list: complete against brute force, canonical, safe to rebuild, and honest about its slack."""

import functools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import SPHERE, blank_state, cached_tetra, cluster27, make_grains, orientations, squeeze
from scipy.spatial import cKDTree

from gmem_jax import native
from gmem_jax.physics import step as dynamics
from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.grain import clump
from gmem_jax.physics.pairs import bucket, carry_history, listed_candidates, slack, sphere_centres, tabulate
from gmem_jax.physics.search import PairFinder
from gmem_jax.physics.state import still_box
from gmem_jax.simulation.sample import end_bin

TETRA = cached_tetra()
CENTRES = jax.jit(sphere_centres)
CASES = {
    # jax-md uses its cell list where every edge holds three cutoffs (about 3.5 for tetrahedra), all pairs otherwise.
    "cells": (TETRA, (14.0, 11.0, 16.0), (13.2, 10.6, 16.0)),
    "few cells": (TETRA, (7.0, 6.0, 9.0), (6.6, 5.8, 9.0)),
    "spheres, cells": (SPHERE, (9.0, 12.0, 10.0), (8.4, 11.0, 10.0)),
    "spheres, few cells": (SPHERE, (5.0, 4.5, 5.5), (5.0, 4.5, 5.5)),
}


def random_grains(clump, lengths, seed: int, count: int = 100):
    position = np.random.default_rng(seed).uniform(0.5, np.array(lengths) - 0.5, (count, 3))
    return make_grains(position, orientations(count, seed))


def box_of(lengths):
    lengths = jnp.asarray(lengths)[:, None]
    return still_box(0.3 + jnp.zeros((3, 1)), 0.3 + lengths)  # not at the origin


def unshifted_box(lengths):
    return still_box(jnp.zeros((3, 1)), jnp.asarray(lengths)[:, None])


def shifted(grains):
    return replace(grains, position=grains.position + 0.3)


def brute_force(spheres: np.ndarray, per_grain: int, reach: float) -> np.ndarray:
    """All pairs (i < j) of different grains closer than reach, in canonical order, [2, n]."""
    distance = np.linalg.norm(spheres[:, None] - spheres, axis=-1)
    grain = np.arange(len(spheres)) // per_grain
    return np.stack(np.nonzero(np.triu((distance < reach) & (grain[:, None] != grain))))


@pytest.mark.parametrize("case", CASES)
def test_the_list_is_the_one_found_by_brute_force_in_canonical_order(case):
    clump, lengths, smallest = CASES[case]
    finder = PairFinder(clump, np.array(lengths), skin=0.4)
    for seed in range(3):  # the first allocates, the others update
        grains = shifted(random_grains(clump, lengths, seed))
        pairs = finder(grains, clump, box_of(lengths), np.array(smallest))
        mapped = (np.asarray(CENTRES(grains, clump))[..., 0] - 0.3) * np.array(smallest) / np.array(lengths)
        expected = brute_force(mapped, clump.spheres, 2.4)
        assert expected.shape[1] > 100
        np.testing.assert_array_equal(listed_candidates(pairs), expected)


@pytest.mark.skipif(native.search() is None, reason=native.available()[1])
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("skin", [0.05, 0.4, 9.0])  # with the last, more than is expected
def test_the_library_finds_the_pairs_that_jax_md_finds(case, skin):
    clump, lengths, smallest = CASES[case]
    for seed in range(2):
        grains, box = random_grains(clump, lengths, seed), unshifted_box(lengths)
        by_jax_md, by_library = (
            PairFinder(clump, np.array(lengths), skin, search=search)(grains, clump, box, np.array(smallest))
            for search in (None, native.search())
        )
        assert by_jax_md.capacity > 8
        jax.tree.map(np.testing.assert_array_equal, by_library, by_jax_md)


@pytest.mark.skipif(native.search() is None, reason=native.available()[1])
def test_the_library_lists_no_pairs_of_what_is_far_apart_or_not_finite():
    search = native.search()
    far = np.array([[0.0, 0.0, 0.0], [1e9, -1e9, 1e9], [1e9, 2.5 - 1e9, 1e9]])  # more cells than there is memory for
    np.testing.assert_array_equal(search(far, 1, 2.6), [1 * 3 + 2])
    np.testing.assert_array_equal(search(far, 3, 2.6), [])
    np.testing.assert_array_equal(search(np.zeros((0, 3)), 4, 2.6), [])
    far[1, 1] = np.nan
    with pytest.raises(ValueError, match="finite"):
        search(far, 1, 2.6)


@pytest.mark.skipif(native.search() is None, reason=native.available()[1])
@pytest.mark.parametrize("edge", [44.0, 22.0])  # some five neighbours of a sphere; forty, more than are expected
def test_threads_that_share_out_the_spheres_find_all_pairs_once_and_in_order(edge, monkeypatch):
    centres = np.random.default_rng(0).uniform(0.0, edge, (9000, 3))
    near = cKDTree(centres).query_pairs(2.5, output_type="ndarray")
    near = near[near[:, 0] // 3 != near[:, 1] // 3]
    for threads in ("1", "2", "3"):
        monkeypatch.setenv("GMEM_THREADS", threads)
        np.testing.assert_array_equal(native.search()(centres, 3, 2.5), np.sort(near[:, 0] * 9000 + near[:, 1]))


@pytest.mark.skipif(native.search() is None, reason=native.available()[1])
def test_a_search_refuses_a_bad_number_of_threads_in_a_sentence(monkeypatch):
    monkeypatch.setenv("GMEM_THREADS", "two")
    with pytest.raises(ValueError, match=r'GMEM_THREADS should be a number of threads .* it is "two"'):
        native.search()(np.zeros((2, 3)), 1, 2.5)


@pytest.mark.parametrize("skin", [0.1, 0.3, 0.4, 1.0])
def test_pairs_are_listed_up_to_the_last_digit_of_the_skin(skin):
    """jax-md keeps its cutoff in single precision, which is less than some of these."""
    lengths, distance = np.array([12.0, 9.0, 9.0]), 2.0 + skin
    for part, listed in ((1.0 - 1e-12, 1), (1.0 + 1e-12, 0)):
        grains = make_grains([[3.0, 4.0, 5.0], [3.0 + part * distance, 4.0, 5.0]])
        pairs = PairFinder(SPHERE, lengths, skin)(grains, SPHERE, unshifted_box(lengths))
        assert listed_candidates(pairs).shape[1] == listed


def test_clumps_that_reach_for_each_other_with_their_outermost_spheres_are_listed():
    grain = clump([[1.2, 0.0, 0.0], [-1.2, 0.0, 0.0]])
    lengths = np.array([20.0, 9.0, 9.0])
    reach = 2.0 + 0.3 + 2.0 * 1.2  # of the centres of two of them in a row
    grains = make_grains([[5.0, 4.0, 5.0], [5.0 + reach * (1.0 - 1e-6), 4.0, 5.0]])
    pairs = PairFinder(grain, lengths, 0.3)(grains, grain, unshifted_box(lengths))
    assert listed_candidates(pairs).shape[1] == 1


@pytest.fixture(scope="module")
def crowd():
    """A list of 100 tetrahedra with its finder, and the grains."""
    lengths = (14.0, 11.0, 16.0)
    finder = PairFinder(TETRA, np.array(lengths), skin=0.4)
    grains = shifted(random_grains(TETRA, lengths, 0))
    return finder, grains, finder(grains, TETRA, box_of(lengths)), box_of(lengths)


def test_padding_is_never_valid_and_pairs_never_belong_to_one_grain(crowd):
    pairs = crowd[2]
    real = np.asarray(pairs.valid)
    first, second = np.asarray(pairs.first), np.asarray(pairs.second)
    assert np.all(first[real] // 4 < second[real] // 4)
    assert np.all(first[~real] == 0)
    assert np.all(second[~real] == 0)
    assert 0 < (~real).sum() < real.sum()


def test_each_pair_appears_once_under_each_of_its_spheres_with_its_sign(crowd):
    pairs = crowd[2]
    rows = np.asarray(pairs.incidence)
    used = np.sort(rows[rows < 2 * pairs.capacity])
    count = listed_candidates(pairs).shape[1]
    np.testing.assert_array_equal(used, np.concatenate([np.arange(count), pairs.capacity + np.arange(count)]))
    for sphere, row in enumerate(rows):
        as_first, as_second = row[row < pairs.capacity], row[(row >= pairs.capacity) & (row < 2 * pairs.capacity)]
        assert np.all(np.asarray(pairs.first)[as_first] == sphere)
        assert np.all(np.asarray(pairs.second)[as_second - pairs.capacity] == sphere)


def test_grain_pairs_number_the_pairs_of_grains_consistently(crowd):
    pairs = crowd[2]
    real = np.asarray(pairs.valid)
    owners = listed_candidates(pairs) // 4
    numbers = np.asarray(pairs.grain_pair)
    together = {}
    for number, one, other in zip(numbers[real], *owners, strict=True):
        assert together.setdefault(number, (one, other)) == (one, other)
    assert len(set(together.values())) == len(together)
    assert not set(numbers[~real]) & set(together)


def test_a_full_list_numbers_its_pairs_of_grains_below_its_capacity():
    found = np.array([(i, j) for i in range(5) for j in range(i + 1, 5)])[:8].T
    pairs = tabulate(found, np.zeros((5, 3, 1)), np.ones(3), 2.4, 1)
    assert pairs.capacity == 8
    np.testing.assert_array_equal(pairs.grain_pair, np.arange(8))


def test_capacities_grow_when_needed_never_shrink_and_lose_nothing():
    lengths = np.array([14.0, 11.0, 16.0])
    finder = PairFinder(TETRA, lengths, skin=0.4, capacity=40, per_sphere=2)
    sizes = []
    for scale in (1.0, 0.5, 1.0):  # in the middle, everybody in an eighth of the volume
        grains = random_grains(TETRA, lengths, 3)
        grains = replace(grains, position=grains.position * scale)
        pairs = finder(grains, TETRA, still_box(jnp.zeros((3, 1)), jnp.asarray(lengths)[:, None]))
        expected = brute_force(np.asarray(CENTRES(grains, TETRA))[..., 0], 4, 2.4)
        np.testing.assert_array_equal(listed_candidates(pairs), expected)
        sizes.append((pairs.capacity, pairs.incidence.shape[1]))
    assert sizes[1][0] > 2 * sizes[0][0] > 80
    assert sizes[1][1] > sizes[0][1] > 2
    assert sizes[2] == sizes[1]


@pytest.mark.parametrize(("given", "allocated"), [((52, 8), (52, 8)), ((50, 7), (52, 8)), ((0, 0), (8, 4))])
def test_a_given_capacity_is_rounded_up_and_kept_when_it_suffices(given, allocated):
    found = np.array([[0, 0, 1], [1, 2, 2]])
    pairs = tabulate(found, np.zeros((3, 3, 1)), np.ones(3), 2.4, 1, capacity=given[0], per_sphere=given[1])
    assert (pairs.capacity, pairs.incidence.shape) == (allocated[0], (3, allocated[1]))


def test_capacities_are_eight_to_an_octave_and_at_most_an_eighth_too_large():
    counts = np.arange(1, 5000)
    sizes = np.array([bucket(int(count)) for count in counts])
    assert np.all((counts <= sizes) & (8 * (sizes - counts) < np.maximum(counts, 8)))
    np.testing.assert_array_equal([bucket(int(size)) for size in sizes], sizes)  # what was allocated fits again
    assert len(set(sizes[(counts > 1024) & (counts <= 2048)])) == 8


def test_the_list_of_replicas_is_the_union_of_their_own():
    one, other = random_grains(SPHERE, (9.0, 12.0, 10.0), 0), random_grains(SPHERE, (9.0, 12.0, 10.0), 1)
    both = jax.tree.map(lambda a, b: jnp.concatenate([a, b], axis=-1), one, other)
    box = still_box(jnp.zeros((3, 1)), jnp.asarray([[9.0], [12.0], [10.0]]))
    finder = PairFinder(SPHERE, np.array([9.0, 12.0, 10.0]), 0.4)
    listed = finder(both, SPHERE, box)
    alone = [{tuple(pair) for pair in listed_candidates(finder(grains, SPHERE, box)).T} for grains in (one, other)]
    assert {tuple(pair) for pair in listed_candidates(listed).T} == alone[0] | alone[1]
    assert len(alone[0] - alone[1]) > 10
    # However far apart the replicas are, each has its whole skin.
    np.testing.assert_allclose(slack(listed, sphere_centres(both, SPHERE), box), 0.4, atol=1e-12)


@pytest.mark.parametrize("skin", [0.0, -0.1, float("nan")])
def test_a_skin_that_is_not_positive_is_refused(skin):
    with pytest.raises(ValueError, match="skin"):
        PairFinder(SPHERE, np.full(3, 10.0), skin)


def test_histories_move_by_pair_and_newcomers_start_blank():
    def listing(found, capacity):
        return tabulate(np.array(found).T, np.zeros((5, 3, 1)), np.ones(3), 2.4, 1, capacity=capacity)

    old = listing([(0, 1), (0, 3), (1, 2), (2, 4)], 6)
    new = listing([(0, 2), (0, 3), (1, 2), (1, 4), (2, 4), (3, 4)], 8)
    history = {"force": jnp.arange(1.0, 7.0)[:, None, None] * jnp.ones((6, 3, 2)), "flag": jnp.arange(1.0, 7.0)}
    blank = {"force": jnp.full((8, 3, 2), -1.0), "flag": jnp.full(8, -1.0)}
    moved = carry_history(history, blank, old, new)
    expected = [-1.0, 2.0, 3.0, -1.0, 4.0, -1.0, -1.0, -1.0]
    np.testing.assert_array_equal(moved["flag"], expected)
    np.testing.assert_array_equal(moved["force"], np.broadcast_to(np.array(expected)[:, None, None], (8, 3, 2)))


def test_carrying_to_and_from_an_empty_list_gives_blanks():
    none = tabulate(np.zeros((2, 0), int), np.zeros((5, 3, 1)), np.ones(3), 2.4, 1, capacity=4)
    some = tabulate(np.array([[0], [1]]), np.zeros((5, 3, 1)), np.ones(3), 2.4, 1, capacity=4)
    assert none.capacity == some.capacity
    shape = (some.capacity, 3, 1)
    ones, blank = jnp.ones(shape), jnp.full(shape, 7.0)
    np.testing.assert_array_equal(carry_history(ones, blank, none, some), blank)
    np.testing.assert_array_equal(carry_history(ones, blank, some, none), blank)


def test_a_gas_too_thin_for_any_candidate_can_still_be_observed():
    box = still_box(jnp.zeros((3, 1)), jnp.full((3, 1), 20.0))
    grains = make_grains([[5.0, 5.0, 5.0], [15.0, 15.0, 15.0]])
    pairs = tabulate(np.zeros((2, 0), int), np.zeros((2, 3, 1)), np.full(3, 20.0), 2.4, 1)
    system = dynamics.System(SPHERE, Hooke(), pairs)
    _, sample = jax.jit(end_bin)(system, blank_state(system, grains), box, jnp.zeros((3, 1)), 0.0)
    assert listed_candidates(pairs).shape == (2, 0)
    assert (float(sample.coordination[0]), float(sample.contacts[0])) == (0.0, 0.0)
    assert float(sample.largest_overlap[0]) <= 0.0


@functools.partial(jax.jit, static_argnames="count")
def continue_run(system, state, motion, first, *, count):
    """`count` steps of 0.3 from step `first`; returns the state and the wall forces, [count, 2, 3, B]."""

    def one(state, index):
        return dynamics.step(system, state, motion.box_at((index + 1) * 0.3), 0.3, 0.0, index >= 0)

    return jax.lax.scan(one, state, first + jnp.arange(count))


def squeezed_cluster(rebuild: bool):
    """200 steps of fast frictional compression; optionally a new list (other skin, other pairs) every 20 steps."""
    system, state, box = cluster27(skin=0.5)
    motion = squeeze(box, 120.0, delta0=0.1)
    sizes = {"capacity": system.pairs.capacity, "per_sphere": system.pairs.incidence.shape[1]}
    finder = PairFinder(TETRA, np.asarray(box.lengths)[:, 0], skin=0.25, **sizes)
    listed, walls = [], []
    for first in range(0, 200, 20):
        if rebuild:
            pairs = finder(state.grains, TETRA, motion.box_at(jnp.asarray(first * 0.3)))
            blank = system.friction.init(pairs.capacity, 1, float)
            history = carry_history(state.history, blank, system.pairs, pairs)
            system, state = replace(system, pairs=pairs), replace(state, history=history)
        listed.append(frozenset(map(tuple, listed_candidates(system.pairs).T)))
        state, forces = continue_run(system, state, motion, first, count=20)
        walls.append(forces)
    return state, np.concatenate(walls), listed


def test_rebuilding_the_list_all_the_time_changes_nothing():
    kept, kept_walls, _ = squeezed_cluster(rebuild=False)
    rebuilt, rebuilt_walls, listed = squeezed_cluster(rebuild=True)
    assert len(set(listed)) > 3  # the rebuilt lists did differ
    assert np.abs(kept.history).max() > 1e-3  # and there was friction to lose
    # Bit for bit on this CPU: candidates apart add exact zeros and the others keep their order. But the order in which
    # a sphere's row is summed is the compiler's business, so round-off is allowed for.
    np.testing.assert_allclose(rebuilt_walls, kept_walls, rtol=1e-12)
    np.testing.assert_allclose(rebuilt.grains.position, kept.grains.position, rtol=1e-13)


def test_slack_is_the_skin_when_nothing_moved_even_in_the_smallest_box():
    lengths, smallest = np.array([9.0, 12.0, 10.0]), np.array([8.4, 11.0, 10.0])
    grains = random_grains(SPHERE, lengths, 0)
    box = still_box(jnp.zeros((3, 1)), jnp.asarray(lengths)[:, None])
    pairs = PairFinder(SPHERE, lengths, 0.4)(grains, SPHERE, box, smallest)
    assert float(slack(pairs, CENTRES(grains, SPHERE), box)[0]) == pytest.approx(0.4, rel=1e-13)
    small = still_box(jnp.zeros((3, 1)), jnp.asarray(smallest)[:, None])
    squeezed = replace(grains, position=grains.position * (smallest / lengths)[:, None])
    assert float(slack(pairs, CENTRES(squeezed, SPHERE), small)[0]) == pytest.approx(0.4, rel=1e-13)


def test_slack_shrinks_when_the_box_gets_smaller_than_the_smallest():
    lengths = np.array([9.0, 12.0, 10.0])
    grains = random_grains(SPHERE, lengths, 0)
    box = still_box(jnp.zeros((3, 1)), jnp.asarray(lengths)[:, None])
    pairs = PairFinder(SPHERE, lengths, 0.4)(grains, SPHERE, box)
    tight = still_box(jnp.zeros((3, 1)), jnp.asarray(lengths * [0.9, 1.0, 1.0])[:, None])
    squeezed = replace(grains, position=grains.position * jnp.asarray([0.9, 1.0, 1.0])[:, None])
    assert float(slack(pairs, CENTRES(squeezed, SPHERE), tight)[0]) == pytest.approx(0.9 * 2.4 - 2.0, rel=1e-12)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("narrowing", [1.0, 0.93])
def test_slack_is_negative_before_any_unlisted_pair_can_touch(seed, narrowing):
    """The worst case: the nearest unlisted pair heads straight for each other while the box shrinks or not."""
    lengths, smallest = np.array([9.0, 12.0, 10.0]), np.array([8.6, 11.0, 10.0])
    grains = random_grains(SPHERE, lengths, seed)
    box = still_box(jnp.zeros((3, 1)), jnp.asarray(lengths)[:, None])
    pairs = PairFinder(SPHERE, lengths, 0.4)(grains, SPHERE, box, smallest)
    now = np.array([narrowing, narrowing, 1.0])
    centres = np.asarray(grains.position)[..., 0] * now
    listed = set(map(tuple, listed_candidates(pairs).T))
    distance = np.linalg.norm(centres[:, None] - centres, axis=-1)
    unlisted = [(distance[i, j], i, j) for i in range(100) for j in range(i + 1, 100) if (i, j) not in listed]
    gap, i, j = min(unlisted)
    toward = (centres[j] - centres[i]) / gap * 0.5 * (gap - 2.0)
    narrowed = still_box(jnp.zeros((3, 1)), jnp.asarray(lengths * now)[:, None])
    values = []
    for part in (0.0, 0.5, 1.0 - 1e-9):
        moved = centres.copy()
        moved[i] += part * toward
        moved[j] -= part * toward
        values.append(float(slack(pairs, jnp.asarray(moved)[..., None], narrowed)[0]))
    assert values[0] > values[1] > values[2]
    assert values[2] <= 1e-8  # they are 1e-9 of their gap from touching
    assert values[2] >= -(gap - 2.0)  # and it does not cry wolf long before


def test_slack_is_kept_per_replica():
    grains = random_grains(SPHERE, (9.0, 12.0, 10.0), 0)
    box = still_box(jnp.zeros((3, 1)), jnp.asarray([[9.0], [12.0], [10.0]]))
    pairs = PairFinder(SPHERE, np.array([9.0, 12.0, 10.0]), 0.4)(grains, SPHERE, box)
    centres = jnp.repeat(CENTRES(grains, SPHERE), 2, axis=-1).at[5, 1, 1].add(0.15)
    np.testing.assert_allclose(slack(pairs, centres, box), [0.4, 0.1], rtol=1e-12)
