"""The friction laws on a single contact, against closed forms and against what thermodynamics allows."""

import functools
import importlib.util
import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes

from gmem_jax.physics.contact.friction import FrictionLaw, largest_overlap
from gmem_jax.physics.contact.frictionless import Frictionless
from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.contact.kinematics import kinematics
from gmem_jax.physics.contact.mindlin import Mindlin
from gmem_jax.physics.contact.mindlin_rescaled import MindlinRescaled
from gmem_jax.physics.contact.normal import hertz
from gmem_jax.physics.contact.path import contact_path, lead_contact, led_contact, polyline
from gmem_jax.physics.material import Material

LENGTH = 501
STUCK = 1e6  # a friction coefficient that never slides
VARIANTS = ("averaged", "exact", "paper")
LAWS = {"H": Hooke(), "M1": MindlinRescaled(), **{f"M2 {v}": Mindlin(variant=v) for v in VARIANTS}}
PASSIVE = {name: LAWS[name] for name in ("H", "M1", "M2 averaged")}
FIG10 = [(0.0, 0.0), (0.5, 0.0), (0.5, 0.8), (1.0, 0.8), (1.0, 1.0), (0.0, 1.0)]
path_force = jax.jit(contact_path)
call = jax.jit(lambda law, *arguments: law(*arguments))

every_law = pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
every_passive_law = pytest.mark.parametrize("law", PASSIVE.values(), ids=PASSIVE)


def unit(law, **changes):
    """The law with unit stiffness and without sliding or dashpot."""
    return replace(law, mu=STUCK, stiffness=1.0, damping_time=0.0, **changes)


def along(law, corners, points=50):
    """(p, sigma, force) along straight segments between corners (p, sigma)."""
    path = polyline(jnp.array(corners), points)
    # Resting at the end changes nothing; one length for many paths compiles a law once.
    padded = jnp.concatenate([path, jnp.tile(path[-1], (max(0, LENGTH - len(path)), 1))])
    overlap, displacement = path.T
    return overlap, displacement, path_force(law, *padded.T)[: len(path)]


def work_along(displacement, force):
    """Work done on the contact from the start to each point."""
    return np.cumsum(0.5 * np.asarray(force[1:] + force[:-1]) * np.diff(displacement))


@pytest.fixture(scope="module")
def own_law(tmp_path_factory):
    """The module of the law in docs/own_law.md, as a user's own file."""
    page = (scenes.ROOT / "docs" / "own_law.md").read_text()
    file = tmp_path_factory.mktemp("user") / "plain_mindlin.py"
    file.write_text(re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL)[0])
    spec = importlib.util.spec_from_file_location("plain_mindlin", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


# ---------------------------------------------------------------- closed forms


def test_hooke_follows_figure_10_to_the_last_digit():
    overlap, displacement, force = along(unit(Hooke()), FIG10)
    expected = np.where(overlap > 0.0, displacement, 0.0)
    np.testing.assert_allclose(force, expected, rtol=0, atol=1e-13)


def test_m1_follows_figure_10_to_the_last_digit():
    overlap, displacement, force = along(unit(MindlinRescaled()), FIG10)
    sheared = np.sqrt(0.5) * np.minimum(displacement, 0.8) + np.maximum(displacement - 0.8, 0.0)
    np.testing.assert_allclose(force[:201], sheared[:201], rtol=0, atol=1e-13)
    unloading = (0.8 * np.sqrt(0.5) + 0.2) * np.sqrt(overlap[200:])
    np.testing.assert_allclose(force[200:], unloading, rtol=0, atol=1e-13)


@pytest.mark.parametrize("variant", VARIANTS)
def test_m2_follows_figure_10_within_one_ring(variant):
    law = unit(Mindlin(variant=variant), p_max=1.5)
    overlap, _, force = along(law, FIG10)
    unloading = overlap[200:]
    expected = 0.8 * np.minimum(np.sqrt(unloading), np.sqrt(0.5)) + 0.2 * np.sqrt(unloading)
    error = np.abs(force[200:] - expected)
    assert error.max() < 0.8 * float(law.spacing)
    if variant == "averaged":  # what is in error is the ring at which the contact stood when it was sheared
        far = np.abs(np.sqrt(unloading) - np.sqrt(0.5)) > float(law.spacing)
        assert error[far].max() < 1e-12


def test_m2_discretisation_error_falls_with_the_spacing_of_the_points():
    # Load obliquely, sigma = sqrt(p), then unload at constant sigma: f(q) = 1 - q, so f_e = sqrt(p) - p / 2.
    root = jnp.concatenate([jnp.linspace(0.0, 1.0, 2001), jnp.linspace(1.0, 0.0, 2001)[1:]])
    displacement = jnp.where(jnp.arange(4001) < 2000, root, 1.0)
    exact = (root - root**2 / 2.0)[2000:]
    rings = np.array([7.5, 15.5, 31.5, 63.5])  # in the contact area at sqrt(p) = 1
    orders = {}
    for variant in VARIANTS:

        def error(p_max, law=unit(Mindlin(variant=variant))):  # noqa: B008
            force = contact_path(replace(law, p_max=p_max), root**2, displacement)
            return jnp.sqrt(jnp.mean((force[2000:] - exact) ** 2))

        errors = jax.jit(jax.vmap(error))((99.0 / rings) ** 2)
        orders[variant] = -np.polyfit(np.log(rings), np.log(errors), 1)[0]
    assert orders["averaged"] > 1.8
    assert orders["exact"] == pytest.approx(1.0, abs=0.1)
    assert orders["paper"] == pytest.approx(1.0, abs=0.1)


def test_the_paper_variant_of_m2_is_too_soft_by_half_a_ring():
    law = unit(Mindlin(variant="paper"))
    spacing = float(law.spacing)
    for root in (0.3 * spacing, 0.7 * spacing, 3.2 * spacing, 0.4):
        _, _, force = along(law, [(0.0, 0.0), (root**2, 0.0), (root**2, 0.01)])
        expected = 0.01 * max(0.0, root - 0.5 * spacing)
        assert float(force[-1]) == pytest.approx(expected, rel=1e-9, abs=1e-15)
        _, _, force = along(replace(law, variant="exact"), [(0.0, 0.0), (root**2, 0.0), (root**2, 0.01)])
        assert float(force[-1]) == pytest.approx(0.01 * root, rel=1e-9)


@pytest.mark.parametrize("variant", VARIANTS)
def test_m2_forgets_what_happened_at_larger_overlap(variant):
    """Johnson and Norris: after unloading to p1 only the displacement since p1 was first passed matters."""
    law = unit(Mindlin(variant=variant))
    shorter = [(0.0, 0.0), (0.05, 0.004), (0.05, 0.009), (0.05, -0.003), (0.05, 0.006)]
    longer = [(0.0, 0.0), (0.05, 0.004), (0.12, 0.009), (0.15, -0.003), (0.05, 0.006)]
    one, other = (float(along(law, corners, points=100)[2][-1]) for corners in (shorter, longer))
    assert abs(one - other) < 0.015 * float(law.spacing)
    rescaled = [float(along(unit(MindlinRescaled()), corners, 100)[2][-1]) for corners in (shorter, longer)]
    assert abs(rescaled[0] - rescaled[1]) > 10.0 * abs(one - other)  # M1 does not have this property


# ---------------------------------------------------------------- energy


def greedy_path(width, out_at, turns=30):
    """Random displacements, out at a small overlap and back at a large one, or the other way round.

    A spring that stiffens at constant displacement, or keeps its force while it softens, yields energy on one of them.
    """
    rng = np.random.default_rng(7)
    corners = [(0.0, 0.0)]
    for sigma in 0.01 * rng.normal(size=turns):
        soft, stiff = 0.06 * (1.0 - width * rng.uniform(0.5, 1.0)), 0.06 * (1.0 + width * rng.uniform(0.5, 1.0))
        one, other = (soft, stiff) if out_at == "small overlap" else (stiff, soft)
        corners += [(one, 0.0), (one, sigma), (other, sigma), (other, 0.0)]
        if rng.uniform() < 0.1:
            corners.append((-0.01, 0.0))
    return [*corners, (0.0, 0.0)]


WIDTHS = (0.5, 0.05, 0.003)  # from many rings of M2 to a small part of one
ORDERS = ("small overlap", "large overlap")


@every_passive_law
@pytest.mark.parametrize("mu", [STUCK, 0.1])
def test_no_path_extracts_energy_from_a_passive_law(law, mu):
    law = replace(law, mu=mu, damping_time=0.0)
    for width in WIDTHS:
        for out_at in ORDERS:
            _, displacement, force = along(law, greedy_path(width, out_at), points=2)
            assert work_along(displacement, force).min() >= -1e-18


def test_the_search_for_free_energy_finds_it_where_it_is(own_law):
    found = {
        "plain": (own_law.PlainMindlin(mu=STUCK), "large overlap", (True, True, True)),
        "exact": (replace(LAWS["M2 exact"], mu=STUCK), "small overlap", (False, False, True)),
        "paper": (replace(LAWS["M2 paper"], mu=STUCK), "small overlap", (False, False, True)),
    }
    for name, (law, out_at, creates) in found.items():
        for width, expected in zip(WIDTHS, creates, strict=True):
            _, displacement, force = along(law, greedy_path(width, out_at), points=2)
            assert (work_along(displacement, force)[-1] < 0.0) == expected, (name, width)


def rectangle(p, high, sigma=0.01):
    """Shear at overlap p, move to overlap `high`, shear back there, return."""
    return [(0.0, 0.0), (p, 0.0), (p, sigma), (high, sigma), (high, 0.0), (p, 0.0)]


@every_law
@pytest.mark.parametrize("high", [0.12, 0.03])
def test_a_wide_cycle_creates_no_energy(law, high):
    _, displacement, force = along(unit(law), rectangle(0.06, high))
    work = work_along(displacement, force)[-1]
    scale = 0.5 * 0.01**2
    if isinstance(law, Hooke):
        assert abs(work) < 1e-12 * scale
    else:
        assert work > 0.05 * scale


def test_within_one_ring_only_the_averaged_variant_of_m2_is_passive():
    law = unit(Mindlin())
    inside_a_ring = rectangle((30.3 * float(law.spacing)) ** 2, (30.7 * float(law.spacing)) ** 2)
    work = {}
    for variant in VARIANTS:
        _, displacement, force = along(replace(law, variant=variant), inside_a_ring)
        work[variant] = work_along(displacement, force)[-1]
    ring = 0.5 * 0.01**2 * float(law.spacing)
    assert work["averaged"] > 0.1 * ring
    assert work["exact"] == pytest.approx(-0.4 * ring, rel=1e-6)
    assert work["paper"] == pytest.approx(-0.4 * ring, rel=1e-6)


def test_a_users_own_law_needs_one_file_and_plain_mindlin_creates_energy(own_law):
    law = own_law.PlainMindlin(mu=STUCK, stiffness=1.0)
    assert isinstance(law, FrictionLaw)
    # Sheared at p and sheared back at a smaller overlap it returns more than it took (see the page).
    _, displacement, force = along(law, rectangle(0.1, 0.05))
    created = 0.5 * 0.01**2 * (np.sqrt(0.1) - np.sqrt(0.05))
    assert work_along(displacement, force)[-1] == pytest.approx(-created, rel=1e-9)


def test_a_users_own_law_runs_in_the_simulator(own_law):
    velocity = [[0.0, 0.0, 0.0], [1e-3, 0.0, 0.0]]
    law = own_law.PlainMindlin(mu=0.5)
    system, state, box = scenes.scene(scenes.SPHERE, [[0.0, 0.0, 0.0], [0.0, 0.0, 1.95]], None, velocity, friction=law)
    spin = scenes.coast(system, state, box, 0.1, 20).grains.spin[:, 1, 0]
    assert np.all(spin > 1e-6)  # friction turns both the same way


# ---------------------------------------------------------------- Coulomb


@every_law
def test_a_sliding_contact_carries_the_friction_limit_and_resumes_from_it(law):
    p, mu = 0.05, 0.4
    law = replace(law, mu=mu)
    limit = mu * Material().normal_stiffness * p**1.5
    sliding = jnp.concatenate([jnp.full(400, 1e-3), jnp.zeros(5), jnp.full(400, -1e-3)])
    force = np.asarray(lead_contact(law, jnp.full(805, p), sliding, 0.3))
    assert force.max() == pytest.approx(limit, rel=1e-14)
    assert force[399] == pytest.approx(limit, rel=1e-14)
    # The spring of a contact that slid carries what the dashpot did not, so that the force goes on without a jump:
    # at rest the dashpot is gone.
    dashpot = law.damping_time * law.stiffness * 1e-3 * (1.0 if isinstance(law, Hooke) else np.sqrt(p))
    assert force[400] == pytest.approx(limit - dashpot, rel=1e-12)
    assert force[-1] == pytest.approx(-limit, rel=1e-14)


@every_law
def test_the_force_follows_the_limit_down_when_a_contact_opens(law):
    overlap = jnp.linspace(0.1, -0.01, 200)
    force = np.asarray(path_force(replace(law, mu=0.2), overlap, jnp.linspace(0.0, 0.5, 200)))
    limit = 0.2 * Material().normal_stiffness * np.clip(overlap, 0.0, None) ** 1.5
    assert np.all(force <= limit * (1 + 1e-12))
    np.testing.assert_allclose(force[60:], limit[60:], rtol=1e-12)


# ---------------------------------------------------------------- transport


@functools.partial(jax.jit, static_argnames="steps")
def tumble(law, angle, steps):
    """Shear a contact along x, then turn it as a rigid body about y (tumbling) and about n (spinning)."""
    dt, p = 0.3, 0.05
    arm = 2.0 - p

    def one_step(history, sample):
        normal, velocity, spin = sample
        kin = kinematics(
            arm * normal[None, :, None], velocity[None, :, None], 2 * spin[None, :, None], jnp.ones(1, bool), dt
        )
        force, history = law(kin, hertz(kin.safe_overlap, 0.0, kin.touching, 1.0, 0.0), history)
        return history, force[0, :, 0]

    shear, ramp = 20, angle * (1.0 - jnp.cos(jnp.pi * jnp.arange(1, steps + 1) / steps)) / 2.0
    rate = angle * jnp.pi * jnp.sin(jnp.pi * jnp.arange(1, steps + 1) / steps) / (2.0 * steps * dt)
    z, x, y = jnp.eye(3)[2], jnp.eye(3)[0], jnp.eye(3)[1]
    normal = jnp.cos(ramp)[:, None] * z + jnp.sin(ramp)[:, None] * x
    tangent = jnp.cos(ramp)[:, None] * x - jnp.sin(ramp)[:, None] * z
    spin = rate[:, None] * (y + normal)
    velocity = rate[:, None] * arm * tangent
    normals = jnp.concatenate([jnp.tile(z, (shear + 1, 1)), normal])
    velocities = jnp.concatenate([jnp.tile(1e-4 * x, (shear, 1)), jnp.zeros((1, 3)), velocity])
    spins = jnp.concatenate([jnp.zeros((shear + 1, 3)), spin])
    _, force = jax.lax.scan(one_step, law.init(1, 1, float), (normals, velocities, spins))
    return force[shear], force[-1], normals[-1], tangent[-1], ramp[-1]


@every_law
def test_a_stuck_contact_carries_its_force_through_tumbling_and_spinning(law):
    angle, steps = 1.2, 600
    before, after, normal, tangent, turned = tumble(replace(law, mu=STUCK), angle, steps)
    binormal = jnp.cross(normal, tangent)
    expected = float(before[0]) * (jnp.cos(turned) * tangent + jnp.sin(turned) * binormal)
    # Projecting on a plane tilted by t turns a vector by t^2 / 4 at most; the tilts here are (pi/2)-bumps of a sine.
    largest = 0.25 * angle**2 * (np.pi**2 / 8.0) / steps
    assert float(jnp.linalg.norm(after - expected)) < largest * float(before[0])
    assert float(jnp.linalg.norm(after)) == pytest.approx(float(before[0]), rel=1e-9)


# ---------------------------------------------------------------- time step


@every_passive_law
def test_the_force_is_second_order_in_the_time_step(law):
    duration, law = 60.0, replace(law, mu=STUCK, damping_time=0.0)
    counts = np.array([80, 160, 320, 640, 5120])

    @jax.jit
    def force(steps):
        time = jnp.minimum(duration, duration * jnp.arange(counts[-1] + 1) / steps)
        overlap = 0.06 + 0.04 * jnp.sin(2.0 * jnp.pi * time / 25.0)
        sliding = 1e-3 * jnp.cos(2.0 * jnp.pi * time / 17.0 + 0.5) * jnp.sin(jnp.pi * time / duration) ** 2
        return lead_contact(law, overlap, sliding, duration / steps)[-1]

    forces = np.array([float(force(count)) for count in counts])
    error = np.abs(forces[:-1] / forces[-1] - 1.0)
    assert error[-1] < 1e-4
    assert -np.polyfit(np.log(counts[:-1]), np.log(error), 1)[0] > 1.8


# ---------------------------------------------------------------- blanks and derivatives


def one_contact(overlap, dtype=float):
    """Kinematics of one sliding contact."""
    kin = jax.tree.map(np.asarray, led_contact(jnp.array(overlap), jnp.array(1e-3), 0.3))
    return jax.tree.map(lambda leaf: leaf if leaf.dtype == bool else leaf.astype(dtype), kin)


@every_law
def test_an_untouched_contact_is_exactly_blank_whatever_it_was_before(law):
    blank = law.init(1, 1, float)
    _, history = call(law, one_contact(0.05), np.full((1, 1, 1), 1e-2), blank)
    for overlap in (0.0, -0.1):
        for past in (blank, history):
            force, after = call(law, one_contact(overlap), np.zeros((1, 1, 1)), past)
            assert not np.any(force)
            for leaf, empty in zip(jax.tree.leaves(after), jax.tree.leaves(blank), strict=True):
                assert leaf.shape == empty.shape
                assert leaf.dtype == empty.dtype
                assert not np.any(leaf)


@every_law
def test_single_precision_stays_single(law):
    single = np.dtype(np.float32)
    force, history = call(law, one_contact(0.05, single), np.full((1, 1, 1), 1e-2, single), law.init(1, 1, single))
    assert force.dtype == single
    assert {leaf.dtype for leaf in jax.tree.leaves(history)} == {single}


AWKWARD = {
    "nothing moves": ([0.05] * 6, [0.0] * 6),
    "first touch at zero overlap": ([-0.01, 0.0, 0.0, 0.01, 0.02, 0.02], [0.0, 0.0, 0.001, 0.001, 0.002, 0.003]),
    "lift-off and return": ([0.01, 0.02, -0.01, 0.0, 0.03, 0.02], [0.0, 0.001, 0.002, 0.003, 0.004, 0.005]),
    "never touches": ([-0.01, 0.0, -0.02, 0.0, -0.01, -0.01], [0.0, 0.1, 0.2, 0.3, 0.4, 0.5]),
    "exactly at the friction limit": ([0.05] * 6, [0.0, 0.1, 0.2, 0.2, 0.2, 0.2]),
    "on a point of M2": (
        [(0.2**0.5 / 99 * k) ** 2 for k in (1, 2, 3, 3, 2, 1)],
        [0.0, 0.0, 0.001, 0.002, 0.002, 0.002],
    ),
}


@pytest.mark.parametrize("name", [name for name in LAWS if name != "M2 exact"])  # whose code "M2 averaged" contains
def test_derivatives_are_finite_where_things_vanish(name):
    def total(law, overlap, displacement):
        return jnp.sum(contact_path(law, overlap, displacement, dt=1.0) ** 2)

    overlap, displacement = (jnp.array(column) for column in zip(*AWKWARD.values(), strict=True))
    derivatives = jax.jit(jax.vmap(jax.grad(total, argnums=(0, 1, 2)), in_axes=(None, 0, 0)))
    gradients = derivatives(replace(LAWS[name], mu=0.5), overlap, displacement)
    for number, case in enumerate(AWKWARD):
        assert all(np.all(np.isfinite(leaf[number])) for leaf in jax.tree.leaves(gradients)), case


@every_passive_law
def test_derivatives_agree_with_finite_differences(law):
    overlap, displacement = polyline(jnp.array([(0.02, 0.0), (0.05, 0.004), (0.04, 0.009), (0.06, 0.002)]), 7).T

    @jax.jit
    def final(values):
        mu, stiffness, scale = values
        return contact_path(replace(law, mu=mu, stiffness=stiffness), overlap * scale, displacement, dt=1.0)[-1]

    slope = jax.jit(jax.grad(final))
    for mu in (STUCK, 0.3):
        values = jnp.array([mu, 0.3, 1.0])
        for k, step in enumerate(np.diag([1e-6 * mu, 1e-6, 1e-6])):
            difference = (final(values + step) - final(values - step)) / (2.0 * step[k])
            assert float(slope(values)[k]) == pytest.approx(float(difference), rel=1e-5, abs=1e-9)


# ---------------------------------------------------------------- parameters


@every_law
def test_replicas_and_vmap_over_a_parameter_agree(law):
    mus = jnp.array([0.1, 0.4, STUCK])
    overlap, sliding = polyline(jnp.array([(0.02, 0.0), (0.05, 0.004), (0.04, 0.009)]), 5).T

    def replicated(history, sample):
        kin = led_contact(jnp.repeat(sample[0], 3), jnp.repeat(sample[1], 3), 1.0)
        normal = hertz(kin.safe_overlap, 0.0, kin.touching, Material().normal_stiffness, 0.0)
        force, history = replace(law, mu=mus)(kin, normal, history)
        return history, force[0, 0]

    mapped = jax.vmap(lambda mu: lead_contact(replace(law, mu=mu), overlap, sliding, 1.0), out_axes=-1)(mus)
    _, together = jax.lax.scan(replicated, law.init(1, 3, float), (overlap, sliding))
    np.testing.assert_allclose(together, mapped, rtol=1e-13, atol=1e-18)


def test_only_m2_has_a_largest_overlap():
    assert largest_overlap(Mindlin(p_max=0.3)) == 0.3
    for law in (Hooke(), MindlinRescaled(), Frictionless()):
        assert largest_overlap(law) == float("inf")


def test_bad_parameters_of_m2_are_refused():
    with pytest.raises(ValueError, match=r"Mindlin\.points must be 2 to 10000, got 1"):
        Mindlin(points=1)
    with pytest.raises(ValueError, match="variant"):
        Mindlin(variant="trapezoid")
