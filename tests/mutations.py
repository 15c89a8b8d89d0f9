"""Wrong code that the tests must notice, tried on demand: ``python tests/mutations.py [names]`` or ``make mutations``.

The repository is copied to a temporary folder; there each mutation is made in turn, the native library rebuilt if it is
in C++, and the tests that are named beside it are run until one fails. A mutation that they all pass has survived: the
exit code is then 1. Before, all these tests must pass on the code as it is. A mutation whose text or tests cannot be
found is an error (exit code 2): the table is to be kept in step with the code.

The library is built for one instruction set and without much optimisation here, and objects that a mutation does not
concern are not built again.
"""

import argparse
import fnmatch
import hashlib
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).resolve()
ROOT = HERE.parents[1]
LEFT_OUT = (".*", "__pycache__", "*.egg-info", "build", "dist", "out", "*.so", "gmem-*")
PATIENCE = 600.0  # seconds for the tests of one mutation; one that makes them hang has been noticed
COMPILED = (".cc", ".h")
# The instruction set that is built here and stands for all; the narrowest would not fill its vectors with contacts.
ONE_SET = "avx2" if platform.machine().lower() in ("x86_64", "amd64") else "baseline"


@dataclass(frozen=True)
class Mutation:
    """A change for the worse.

    Attributes:
        name: for the command line.
        file: the end of its path, below the package.
        text: as it is; there must be one of it.
        wrong: in its place.
        tests: names of test functions, one of which must fail; a parameter may follow in brackets.
    """

    name: str
    file: str
    text: str
    wrong: str
    tests: tuple[str, ...]


def mutation(name: str, file: str, text: str, wrong: str, *tests: str) -> Mutation:
    return Mutation(name, file, text, wrong, tests)


DOMAINS = "test_spinning_sliding_grains_of_several_domains_move_as_defined"
ACROSS = "test_derivatives_cross_the_domains_as_defined"
AT_ROUGH_WALLS = "test_the_adjoint_at_walls_with_friction_is_the_transpose_of_the_tangent"
IN_A_PERIODIC_BOX = "test_the_adjoint_in_a_periodic_box_is_the_transpose_of_the_tangent"
CENSUS = "test_the_census_is_that_of_the_definition"
UNEQUAL = "test_values_of_unequal_spheres_are_those_of_the_definition"
KERNELS = "test_the_kernels_give_the_values_and_tangents_of_the_definition"
BACK = "test_the_adjoint_of_the_kernels_is_that_of_the_cpu_and_the_transpose_of_their_tangent"
AFAR = "test_grains_that_come_from_afar_meet_when_they_should"
GAS = "test_the_gas_has_the_speeds_and_spins_of_the_recipe_each_at_random"
MEAN = "test_a_running_mean_is_the_mean_over_the_part_of_its_window_that_is_inside"
PISTON = "test_the_piston_has_settled_when_pressure_and_speed_are_both_within_their_bounds"

MUTATIONS = (
    # ---------------------------------------------------------------- physics: the step and what is observed
    mutation(
        "step-position",
        "physics/step.py",
        "position=old.position + dt * velocity",
        "position=old.position + dt * old.velocity",
        "test_a_collision_without_friction_or_damping_is_second_order",
    ),
    mutation(
        "step-spins-of-the-beginning",
        "physics/step.py",
        "        spin=spin,",
        "        spin=old.spin,",
        "test_work_of_the_walls_is_what_was_stored_damped_and_slid_away",
    ),
    mutation(
        "search-shares-over-one-another",
        "cpu/search.cc",
        "keys + std::min(found, room)",
        "keys",
        "test_threads_that_share_out_the_spheres_find_all_pairs_once_and_in_order",
    ),
    mutation(
        "walls-friction-spins-the-other-way",
        "physics/contact/wall.py",
        "velocity - arm * cross(spin, normal)",
        "velocity + arm * cross(spin, normal)",
        "test_a_sphere_that_slides_on_the_floor_rolls_with_five_sevenths_of_its_speed[law0]",
    ),
    mutation(
        "walls-friction-as-stiff-as-between-grains",
        "physics/contact/wall.py",
        "(material.wall_stiffness / material.normal_stiffness) ** 2 * wide",
        "1.0 * wide",
        "test_a_sphere_on_the_floor_sticks_by_its_spring_and_slides_at_the_limit[M1-1.0-1.0]",
    ),
    mutation(
        "native-walls-friction-forgets-nothing",
        "physics/motion.h",
        "for (int q = 0; q < Law::kHistory; ++q) own[q] = V{};",
        "",
        "test_values_at_walls_with_friction_are_those_of_the_definition[M1-5-file0]",
    ),
    mutation(
        "native-walls-friction-not-turned",
        "physics/motion.h",
        "now.turned = walls.quarter_dt * dot(spin, now.normal);",
        "now.turned = V{};",
        "test_values_at_walls_with_friction_are_those_of_the_definition[M1-5-file0]",
    ),
    mutation(
        "native-walls-rings-as-stiff-as-between-grains",
        "physics/motion.h",
        "const V stiffer_by = p.wall_stiffness / walls.normal_stiffness;",
        "const V stiffer_by = splat<V>(1.0);",
        "test_values_at_walls_with_friction_are_those_of_the_definition[M2-5-file1]",
    ),
    mutation(
        "native-walls-friction-in-the-virial",
        "cpu/block.h",
        "problem.rubs ? force - load_vec(rubbed + 3 * static_cast<std::size_t>(u)) : force;",
        "force;",
        "test_values_at_walls_with_friction_are_those_of_the_definition[H-5-file2]",
    ),
    mutation(
        "adjoint-of-rings-at-walls-not-put-back",
        "cpu/adjoint.h",
        "    restore_segments(step, u);\n",
        "",
        f"{AT_ROUGH_WALLS}[M2-file2]",
    ),
    mutation(
        "adjoint-of-walls-friction-in-the-virial",
        "cpu/adjoint.h",
        "if (problem.periodic) add_vec(result_bar, load_vec(of_grain(rubbed_bar, u, 3)));",
        "",
        f"{AT_ROUGH_WALLS}[M1-file5]",
    ),
    mutation(
        "gpu-walls-friction-without-torque",
        "cuda/step.h",
        "if constexpr (rubs) sum.torque = sum.torque + wall.vec(at + 6);",
        "",
        f"{KERNELS}[rough-M1]",
    ),
    mutation(
        "step-gravity-upwards",
        "physics/system.py",
        ".add(-jnp.asarray(self.gravity",
        ".add(jnp.asarray(self.gravity",
        "test_a_free_grain_falls_as_galilei_says",
    ),
    mutation(
        "native-gravity-left-out",
        "physics/motion.h",
        "pull.z = pull.z - p.gravity;",
        "",
        "test_a_march_is_a_step_for_each_box[0.001]",
    ),
    mutation(
        "native-gravity-left-out-of-periodic-boxes",
        "physics/motion.h",
        "acceleration(m.velocity.z, force.z, cell.rate.z, p.gravity)",
        "acceleration(m.velocity.z, force.z, cell.rate.z, V{})",
        "test_values_between_walls_along_one_axis[0.001]",
    ),
    mutation(
        "step-spin-drag",
        "physics/step.py",
        "(turning - drag * spin)",
        "turning",
        "test_drag_slows_a_free_grain_at_its_rate",
    ),
    mutation(
        "step-gyroscopic-term",
        "physics/step.py",
        "(body_torque - cross(spin, inertia * spin))",
        "body_torque",
        "test_a_symmetric_top_precesses_at_the_rate_of_its_angular_momentum",
    ),
    mutation(
        "step-torque-sign",
        "physics/forces.py",
        "torque = kin.arm * cross(kin.normal, tangential)",
        "torque = kin.arm * cross(tangential, kin.normal)",
        "test_an_oblique_collision_conserves_momentum_and_angular_momentum",
    ),
    mutation(
        "pressure-of-one-wall",
        "physics/step.py",
        "(walls[0] + walls[1]) / (2.0 * area)",
        "walls[0] / area",
        "test_wall_pressure_is_the_mean_force_of_two_walls_over_their_area",
    ),
    mutation(
        "energy-of-isotropic-grains",
        "simulation/sample.py",
        "inertia = clump.scaled(clump.inertia[:, None], 5)",
        "inertia = clump.scaled(clump.inertia[:1, None], 5)",
        "test_the_kinetic_energy_of_a_turned_anisotropic_grain_is_that_of_its_own_tensor",
    ),
    mutation(
        "energy-in-the-wrong-frame",
        "simulation/sample.py",
        "body_spin = jnp.sum(matrix(grains.quaternion) * grains.spin[:, :, None], axis=1)\n    inertia",
        "body_spin = grains.spin\n    inertia",
        "test_the_kinetic_energy_of_a_turned_anisotropic_grain_is_that_of_its_own_tensor",
    ),
    mutation(
        "coordination-of-spheres",
        "physics/census.py",
        "jnp.sum(touching > 0, axis=0)",
        "jnp.sum(touching, axis=0)",
        "test_observables_are_those_counted_by_hand",
    ),
    mutation(
        "status-forgotten",
        "simulation/sample.py",
        ").astype(jnp.int32)\n    return replace(state, status=state.status | bits)\n",
        ").astype(jnp.int32)\n    return replace(state, status=bits)\n",
        "test_status_bits_are_sticky",
    ),
    mutation(
        "doubt-of-the-last-stage-alone",
        "experiment/validity.py",
        "largest = jnp.maximum(largest, jnp.max(value, axis=0))",
        "largest = jnp.max(value, axis=0)",
        "test_each_doubt_is_that_of_its_replica_alone",
    ),
    mutation(
        "doubt-kills",
        "physics/state.py",
        "    | Status.DEEP_OVERLAP\n",
        "",
        "test_all_doubts_leave_the_numbers_and_all_else_is_fatal",
    ),
    mutation(
        "stale-too-late",
        "simulation/sample.py",
        "slack_of(system.pairs, census.deviation, box, radii) <= 0.0",
        "slack_of(system.pairs, census.deviation, box, radii) <= -0.01",
        "test_a_list_is_stale_when_a_sphere_has_moved_by_half_its_skin",
    ),
    mutation(
        "stale-too-early",
        "simulation/sample.py",
        "slack_of(system.pairs, census.deviation, box, radii) <= 0.0",
        "slack_of(system.pairs, census.deviation, box, radii) <= 0.01",
        "test_a_list_is_stale_when_a_sphere_has_moved_by_half_its_skin",
    ),
    mutation(
        "box-margin-below",
        "physics/census.py",
        "(spheres < box.lower)",
        "(spheres < box.lower - 0.1)",
        "test_a_grain_is_outside_when_a_sphere_centre_has_crossed_a_wall",
    ),
    mutation(
        "box-margin-above",
        "physics/census.py",
        "(spheres > box.upper)",
        "(spheres > box.upper - 0.01)",
        "test_a_grain_is_outside_when_a_sphere_centre_has_crossed_a_wall",
    ),
    mutation(
        "images-do-not-move-with-the-cell",
        "physics/forces.py",
        "velocity += image_shifts(pairs, cell.growth)",
        "velocity += 0.0",
        "test_where_the_cell_is_cut_changes_nothing[shift1]",
    ),
    mutation(
        "grains-left-behind-by-the-cell",
        "physics/step.py",
        "cell.lower + stretch * (position - before.lower)",
        "position",
        "test_what_the_strain_of_the_cell_does_is_kept_by_grains_without_damping",
    ),
    mutation(
        "pressure-without-momentum-flux",
        "physics/forces.py",
        "force * place + clump.masses * grains.velocity**2",
        "force * place",
        "test_the_pressure_of_a_step_is_the_stress_of_its_contacts_and_the_flux_of_momentum",
    ),
    mutation(
        "one-arm-for-two-radii",
        "physics/forces.py",
        "else kin.other_arm * cross(kin.normal, tangential)",
        "else torque",
        "test_an_oblique_collision_of_unequal_spheres_keeps_momentum_and_angular_momentum[H]",
    ),
    mutation(
        "rolling-of-equal-spheres",
        "contact/kinematics.py",
        "0.5 * (unequal.second - unequal.first) * normal)",
        "0.0 * normal)",
        "test_the_surfaces_of_unequal_spheres_meet_where_their_arms_end",
    ),
    mutation(
        "contacts-as-curved-as-the-first",
        "contact/kinematics.py",
        "radius = 2.0 * unequal.first * unequal.second / reach",
        "radius = unequal.first",
        "test_forces_on_a_small_sphere_are_hertzs_with_its_own_radii",
    ),
    mutation(
        "walls-of-unit-spheres",
        "contact/wall.py",
        "touching, stiffness, damping_time, wide)",
        "touching, stiffness, damping_time)",
        "test_forces_on_a_small_sphere_are_hertzs_with_its_own_radii",
    ),
    mutation(
        "rings-of-unit-spheres",
        "contact/mindlin.py",
        "spacing = self.spacing if kin.radius is None else self.spacing * jnp.sqrt(kin.radius)",
        "spacing = self.spacing",
        "test_a_mindlin_contact_of_other_radii_is_one_that_is_stiffer_by_the_root_of_their_mean[averaged]",
    ),
    mutation(
        "mass-with-the-square-of-the-size",
        "physics/grain.py",
        "return self.scaled(self.mass, 3)",
        "return self.scaled(self.mass, 2)",
        "test_an_elastic_collision_of_unequal_spheres_has_hertzs_duration_and_keeps_energy_and_momentum",
    ),
    mutation(
        "images-of-the-other-side",
        "physics/pairs.py",
        "-np.rint(apart), 0.0)",
        "np.rint(apart), 0.0)",
        "test_the_list_holds_every_pair_of_nearest_images_in_reach_and_says_which[cells-x and z]",
    ),
    # ---------------------------------------------------------------- physics: candidates
    mutation(
        "slack-of-one-sphere",
        "physics/pairs.py",
        "touching - 2.0 * deviation",
        "touching - 1.0 * deviation",
        "test_slack_is_negative_before_any_unlisted_pair_can_touch",
    ),
    mutation(
        "slack-without-the-box",
        "physics/pairs.py",
        "return ratio * pairs.reach",
        "return pairs.reach",
        "test_slack_shrinks_when_the_box_gets_smaller_than_the_smallest",
    ),
    mutation(
        "cutoff-a-little-short",
        "physics/search.py",
        "r_cutoff=self._cutoff + 1e-4",
        "r_cutoff=self._cutoff - 1e-4",
        "test_pairs_are_listed_up_to_the_last_digit_of_the_skin",
    ),
    mutation(
        "cutoff-of-one-clump",
        "physics/search.py",
        "cutoff = 2.0 * largest * float((own + np.linalg.norm(body - body.mean(axis=0), axis=1)).max())",
        "cutoff = 2.0 + largest * float((np.linalg.norm(body - body.mean(axis=0), axis=1)).max())",
        "test_clumps_that_reach_for_each_other_with_their_outermost_spheres_are_listed",
    ),
    mutation(
        "histories-not-carried",
        "physics/pairs.py",
        "jnp.where(kept, leaf[source], empty)",
        "empty",
        "test_histories_move_by_pair_and_newcomers_start_blank",
    ),
    # ---------------------------------------------------------------- physics: contacts, grains, material
    mutation(
        "turn-in-the-body-frame",
        "physics/rotation.py",
        "w * half + cross(half, v)",
        "w * half + cross(v, half)",
        "test_one_turn_is_the_rotation_by_twice_the_arctangent_in_the_lab_frame",
    ),
    mutation(
        "friction-limit-doubled",
        "contact/friction.py",
        "slides = square > limit * limit",
        "slides = square > 4.0 * limit * limit",
        "test_a_sliding_contact_carries_the_friction_limit_and_resumes_from_it",
    ),
    mutation(
        "half-a-step-of-sliding",
        "contact/hooke.py",
        "(self.stiffness * kin.dt) * kin.sliding",
        "(0.5 * self.stiffness * kin.dt) * kin.sliding",
        "test_hooke_follows_figure_10_to_the_last_digit",
    ),
    mutation(
        "spinning-not-asked-for",
        "contact/hooke.py",
        "transport(history, kin, self.spinning)",
        "transport(history, kin)",
        "test_a_law_without_spinning_keeps_its_force_when_a_contact_turns",
    ),
    mutation(
        "walls-always-rigid",
        "physics/material.py",
        "self.wall_rigidity * self.plane_stiffness",
        "self.plane_stiffness",
        "test_soft_walls_leave_the_contacts_of_grains_alone",
    ),
    mutation(
        "walls-not-counted",
        "simulation/sample.py",
        "0.5 * self.contacts + self.wall_contacts",
        "0.5 * self.contacts",
        "test_observables_are_those_counted_by_hand",
    ),
    mutation(
        "twist-of-both-spins",
        "contact/kinematics.py",
        "twist=0.5 * dot(",
        "twist=1.0 * dot(",
        "test_spinning_turns_the_force_about_the_normal_by_half_the_sum_of_the_spins",
    ),
    mutation(
        "magnitude-not-restored",
        "contact/kinematics.py",
        "flat = stretch * flat",
        "flat = 1.0 * flat",
        "test_a_rigidly_rotating_pair_does_not_slide_and_keeps_the_magnitude_of_its_force",
    ),
    mutation(
        "arm-without-overlap",
        "contact/kinematics.py",
        "arm = 1.0 - 0.5 * overlap",
        "arm = jnp.ones_like(overlap)",
        "test_a_rigidly_rotating_pair_does_not_slide_and_keeps_the_magnitude_of_its_force",
    ),
    mutation(
        "m1-rescaled-by-p",
        "contact/mindlin_rescaled.py",
        "jnp.sqrt(ratio) * transport",
        "ratio * transport",
        "test_m1_follows_figure_10_to_the_last_digit",
    ),
    mutation(
        "m2-without-dilution",
        "contact/mindlin.py",
        'if self.variant == "averaged" else',
        'if self.variant == "none" else',
        "test_within_one_ring_only_the_averaged_variant_of_m2_is_passive",
    ),
    mutation(
        "attractive-damping",
        "contact/normal.py",
        "touching & (force > 0.0)",
        "touching",
        "test_damped_spheres_never_attract",
    ),
    mutation(
        "wall-velocity-ignored",
        "contact/wall.py",
        "velocity - box.upper_velocity",
        "velocity",
        "test_a_moving_wall_throws_a_resting_sphere_as_if_the_sphere_had_come_to_it",
    ),
    mutation(
        "inertia-about-the-first-sphere",
        "physics/grain.py",
        "second = second - volume * np.outer(centre, centre)",
        "second = second - 0.0 * np.outer(centre, centre)",
        "test_moments_do_not_depend_on_order_place_or_orientation_of_the_offsets",
    ),
    mutation(
        "spheres-as-stiff-as-walls",
        "physics/material.py",
        "self.plane_stiffness * 2.0**-1.5",
        "self.plane_stiffness * 2.0**-0.5",
        "test_stiffnesses_are_those_of_the_specification",
    ),
    # ---------------------------------------------------------------- the native library
    mutation(
        "packed-remote-torques-swapped",
        "packed.h",
        "to[1] += away_is_one ? torque_one : torque_other;",
        "to[1] += away_is_one ? torque_other : torque_one;",
        f"{DOMAINS}[1-H]",
    ),
    mutation(
        "packed-remote-force-reversed",
        "packed.h",
        "to[0] += away_is_one ? force : -force;",
        "to[0] += away_is_one ? -force : force;",
        f"{DOMAINS}[1-H]",
    ),
    mutation(
        "packed-remote-torque-times-five",
        "packed.h",
        "t[l] += remote[2 * static_cast<std::size_t>(n) + 1];",
        "t[l] += 5.0 * remote[2 * static_cast<std::size_t>(n) + 1];",
        f"{DOMAINS}[1-M1]",
    ),
    mutation(
        "packed-spins-swapped",
        "packed.h",
        "columns(one(&GrainRows::spin)),\n                          columns(other(&GrainRows::spin))};",
        "columns(other(&GrainRows::spin)),\n                          columns(one(&GrainRows::spin))};",
        f"{DOMAINS}[1-H]",
    ),
    mutation(
        "replicas-remote-torques-swapped",
        "replicas.h",
        "(away_is_one ? push.torque_one : push.torque_other));",
        "(away_is_one ? push.torque_other : push.torque_one));",
        f"{DOMAINS}[9-H]",
    ),
    mutation(
        "replicas-remote-force-reversed",
        "replicas.h",
        "store_vec(to, away_is_one ? load_vec(to) + push.force : load_vec(to) - push.force);",
        "store_vec(to, away_is_one ? load_vec(to) - push.force : load_vec(to) + push.force);",
        f"{DOMAINS}[9-H]",
    ),
    mutation(
        "replicas-spin-times-five",
        "replicas.h",
        "load_vec(one + kSpin),\n              load_vec(other + kSpin)};",
        "load_vec(one + kSpin),\n              splat<V>(5.0) * load_vec(other + kSpin)};",
        f"{DOMAINS}[9-M2]",
    ),
    mutation(
        "replicas-remote-torque-lost",
        "replicas.h",
        "torque = torque + convert<V>(load_vec(remote + 6 * static_cast<std::size_t>(n) + 3));",
        "",
        f"{DOMAINS}[9-H]",
    ),
    mutation(
        "replicas-remotes-of-the-last-step",
        "replicas.h",
        "remote + 6 * static_cast<std::size_t>(plan.remote_start[u + 1]), C{});",
        "remote + 6 * static_cast<std::size_t>(plan.remote_start[u]), C{});",
        f"{DOMAINS}[9-H]",
    ),
    mutation(
        "packed-remotes-of-the-last-step",
        "packed.h",
        "remote + 2 * static_cast<std::size_t>(plan.remote_start[end]), Row{});",
        "remote + 2 * static_cast<std::size_t>(plan.remote_start[begin]), Row{});",
        f"{DOMAINS}[1-H]",
    ),
    mutation(
        "remotes-of-a-domain-apart",
        "plan.cc",
        "c.remote = remotes - 1;",
        "c.remote = 0;",
        f"{DOMAINS}[9-H]",
    ),
    mutation(
        "roots-where-nothing-slides-alone",
        "laws.h",
        "kTogether > 1 && !bits_less(limit * limit, c.square)",
        "kTogether > 1 && bits_less(limit * limit, c.square)",
        f"{DOMAINS}[9-H]",
    ),
    mutation(
        "travel-of-one-grain",
        "block.h",
        "travel += 2.0 *",
        "travel += 1.0 *",
        AFAR,
    ),
    mutation(
        "travel-without-spin",
        "block.h",
        "fma(splat<V>(arm), root(spin), root(speed))",
        "root(speed)",
        AFAR,
    ),
    mutation(
        "native-turn-about-the-normal",
        "contact.h",
        "quarter_dt = splat<V>(0.25)",
        "quarter_dt = splat<V>(0.5)",
        f"{DOMAINS}[1-H]",
    ),
    mutation(
        "native-dashpot-in-the-history",
        "laws.h",
        "fnma(law.dashpot, c[n].sliding, c[n].force)",
        "c[n].force",
        f"{DOMAINS}[1-H]",
    ),
    mutation(
        "native-m1-not-rescaled",
        "laws.h",
        "now.sliding, ratio * carried);",
        "now.sliding, carried);",
        f"{DOMAINS}[9-M1]",
    ),
    mutation(
        "native-m2-weights",
        "laws.h",
        "zero_unless(beyond, now.outer - lacking)",
        "zero_unless(beyond, now.x - lacking)",
        f"{DOMAINS}[9-M2]",
    ),
    mutation(
        "native-m2-undiluted",
        "laws.h",
        "select(grows, filled / select(grows, fills, one), one) * layers.rim",
        "layers.rim",
        f"{DOMAINS}[9-M2]",
    ),
    mutation(
        "native-m2-frame-begins-anew",
        "laws.h",
        "select(now.history[kLastOverlap] > V{}, load_vec(now.history), any_tangent(now.normal))",
        "any_tangent(now.normal)",
        f"{DOMAINS}[9-M2]",
    ),
    mutation(
        "native-segments-grow-by-one",
        "physics/segments.h",
        "(last <= before) & (before + one < outer)",
        "(last <= before) & (before + one < before)",
        "test_unit_tests_in_cpp[segments]",
        f"{DOMAINS}[9-narrow rings]",
    ),
    mutation(
        "native-new-rings-like-the-last",
        "physics/segments.h",
        "zero_unless(stays | former, select(",
        "zero_unless(there, select(",
        "test_unit_tests_in_cpp[segments]",
        f"{DOMAINS}[9-narrow rings]",
    ),
    mutation(
        "native-common-part-of-other-lanes",
        "physics/segments.h",
        "zero_unless(differs, layers.common)",
        "layers.common",
        "test_unit_tests_in_cpp[segments]",
        f"{DOMAINS}[9-M2]",
    ),
    mutation(
        "native-rings-of-one-value-have-one-slope",
        "dual.h",
        "differ(a.value, b.value) | differ(a.slope, b.slope)",
        "differ(a.value, b.value)",
        "test_unit_tests_in_cpp[segments]",
    ),
    mutation(
        "tangent-of-a-product",
        "dual.h",
        "fma(a.slope, b.value, a.value * b.slope)}",
        "fma(a.slope, b.value, b.slope)}",
        f"{ACROSS}[H]",
    ),
    mutation(
        "adjoint-remote-spin",
        "adjoint.h",
        "store_vec(to + kRemoteSpin, bar.spin);",
        "store_vec(to + kRemoteSpin, bar.velocity);",
        f"{ACROSS}[H]",
    ),
    mutation(
        "adjoint-remote-centre-lost",
        "adjoint.h",
        "store_vec(to + kRemoteCentre, bar.centre);",
        "store_vec(to + kRemoteCentre, Vec{V{}, V{}, V{}});",
        f"{ACROSS}[H]",
    ),
    mutation(
        "adjoint-remote-of-the-other-sphere",
        "plan.cc",
        "c.away_is_one() ? c.one : c.other",
        "c.away_is_one() ? c.other : c.one",
        f"{ACROSS}[H]",
    ),
    mutation(
        "adjoint-of-the-common-part",
        "adjoint.h",
        "+= bar, at(kLayers + axis)[l] += bar;",
        "+= bar;",
        f"{ACROSS}[M2]",
    ),
    mutation(
        "adjoint-of-the-rings-inside",
        "adjoint.h",
        "fma(weight, layers[2 + axis], bar)",
        "bar",
        f"{ACROSS}[M2]",
    ),
    mutation(
        "adjoint-home-and-away",
        "adjoint.h",
        "give(pair, away_is_one, pair.other,",
        "give(pair, !away_is_one, pair.other,",
        f"{ACROSS}[M2]",
    ),
    mutation(
        "program-select-passes-both",
        "program.h",
        "to_a(zero_unless(mask[now.c], g))",
        "to_a(g)",
        "test_unit_tests_in_cpp[programs]",
    ),
    mutation(
        "program-reached-bars-overwritten",
        "program.h",
        "a_there ? fma(g, value[now.b], bar[now.a]) : g * value[now.b]",
        "g * value[now.b]",
        "test_unit_tests_in_cpp[programs]",
    ),
    mutation(
        "native-chunk-of-an-empty-share",
        "team.cc",
        "if (any(taken)) return true;",
        "return true;",
        "test_unit_tests_in_cpp[threads]",
    ),
    mutation(
        "native-walls-and-spheres",
        "native/march.py",
        "(material.normal_stiffness, material.normal_damping, material.wall_stiffness)",
        "(material.wall_stiffness, material.normal_damping, material.normal_stiffness)",
        f"{DOMAINS}[1-H]",
    ),
    mutation(
        "native-image-without-the-flow",
        "physics/contact.h",
        "m.velocity = m.velocity + cell.flow(m.lever_one - m.lever_other);",
        "",
        "test_values_are_those_of_the_definition[H-5]",
    ),
    mutation(
        "native-image-unseen",
        "cpu/packed.h",
        "(plan.image ? other + image_of(c) * edges(cell) : other)",
        "other",
        "test_values_are_those_of_the_definition[H-1]",
    ),
    mutation(
        "native-carried-by-the-whole",
        "physics/motion.h",
        "half * (p.dt * velocity)",
        "stretch * (p.dt * velocity)",
        "test_values_are_those_of_the_definition[H-1]",
    ),
    mutation(
        "native-section-at-rest",
        "physics/motion.h",
        "fma(force, at - lower, mass * (velocity * velocity))",
        "force * (at - lower)",
        "test_values_are_those_of_the_definition[H-1]",
    ),
    mutation(
        "native-faces-of-one-domain",
        "cpu/block.h",
        "domain < plan.domains; ++domain)\n      sum",
        "domain < 0; ++domain)\n      sum",
        "test_values_are_those_of_the_definition[H-5]",
    ),
    mutation(
        "native-unequal-contact-halfway",
        "physics/contact.h",
        "c.lever_other = c.lever_other + moved;",
        "",
        f"{UNEQUAL}[H]",
    ),
    mutation(
        "native-unequal-rings",
        "physics/contact.h",
        ", c[n].force = unequal[n].root * c[n].force;",
        ";",
        f"{UNEQUAL}[M2-averaged]",
    ),
    mutation(
        "native-unequal-m1-of-radius-one",
        "physics/contact.h",
        ", c[n].root_overlap = unequal[n].root * c[n].root_overlap;",
        ";",
        f"{UNEQUAL}[M1]",
    ),
    mutation(
        "native-census-of-spheres-that-are-near",
        "cpu/census.h",
        "touching = bits_less(square, contact_square) & all_",
        "touching = bits_less(square, splat<V>(4.01)) & all_",
        CENSUS,
    ),
    mutation(
        "native-census-of-grains-counted-by-sphere",
        "cpu/census.h",
        "grains.add(touching);",
        "grains.add(touching), grains.add(touching & 1);",
        CENSUS,
    ),
    mutation(
        "native-census-without-images",
        "cpu/census.h",
        "      if (c_.image) {",
        "      if (false) {",
        CENSUS,
    ),
    mutation(
        "native-census-of-one-reference",
        "cpu/census.h",
        ": at3(c_.reference, s);",
        ": at3(c_.reference, 0);",
        CENSUS,
    ),
    mutation(
        "native-census-of-the-last-thread",
        "cpu/census.h",
        "sum.spheres.add(one.spheres), sum.walls.add(one.walls);",
        "sum.walls.add(one.walls);",
        "test_threads_change_no_bit_and_instruction_sets_round_off",
    ),
    mutation(
        "native-census-hides-what-is-not-finite",
        "cpu/census.h",
        "to(kFinite) = ~bad >> l & 1;",
        "to(kFinite) = 1.0;",
        "test_a_number_that_is_not_finite_is_seen_in_its_replica",
    ),
    mutation(
        "native-size-inertia",
        "cpu/plan.cc",
        "1.0 / (cube * size * size)",
        "1.0 / cube",
        f"{UNEQUAL}[H]",
    ),
    mutation(
        "native-size-walls",
        "physics/motion.h",
        "own.wall_stiffness = root(radius) * p.wall_stiffness;\n    put(",
        "put(",
        f"{UNEQUAL}[frictionless]",
    ),
    mutation(
        "native-size-walls-unseen",
        "physics/motion.h",
        "deepest(splat<V>(outer) * size, m.position, box)",
        "deepest(splat<V>(outer), m.position, box)",
        "test_values_of_bidisperse_spheres_and_in_periodic_boxes_are_those_of_the_definition[H-spheres]",
    ),
    mutation(
        "native-size-section",
        "cpu/block.h",
        "mode.size_of(u, &Size::cube) * parameter[kMass]",
        "parameter[kMass]",
        "test_values_of_bidisperse_spheres_and_in_periodic_boxes_are_those_of_the_definition[M1-periodic]",
    ),
    mutation(
        "native-unequal-reach",
        "cpu/replicas.h",
        "differ ? splat<V>(radii->square) : contact_square",
        "contact_square",
        f"{UNEQUAL}[H]",
    ),
    mutation(
        "native-unequal-reach-of-one",
        "cpu/packed.h",
        "square < radii.square",
        "square < 4.0",
        "test_a_replica_of_unequal_spheres_has_the_same_bits_alone[H]",
    ),
    mutation(
        "native-unequal-looked-at-late",
        "cpu/replicas.h",
        "next_check(travel, smallest(square), radii->reach, plan.far)",
        "next_check(travel, smallest(square))",
        "test_large_spheres_that_come_from_afar_meet_when_they_should[5]",
    ),
    mutation(
        "native-sizes-of-another-pack",
        "cpu/plan.cc",
        "function(list.sizes, list.grains * sizeof(double))",
        "true",
        "test_a_list_is_remembered_with_the_sizes_of_its_grains",
    ),
    mutation(
        "native-slopes-by-sizes-forgotten",
        "native/march.py",
        "(shape.radii, shape.sizes)",
        "(shape.radii,)",
        "test_derivatives_by_sizes_are_those_of_the_definition",
    ),
    # ---------------------------------------------------------------- the GPU's half of it
    mutation(
        "gpu-unequal-point-halfway",
        "cuda/step.h",
        "point = point + differing.lean * contact.normal;",
        "",
        KERNELS + "[spread-H]",
    ),
    mutation(
        "gpu-unequal-arms",
        "cuda/step.h",
        "lever = splat<V>(size_of(on, on.item)) * lever;",
        "",
        KERNELS + "[spread-H]",
    ),
    mutation(
        "gpu-size-mass",
        "cuda/step.h",
        "splat<V>(1.0 / cube)",
        "splat<V>(1.0)",
        KERNELS + "[spread-H]",
    ),
    mutation(
        "gpu-lever-of-the-other",
        "cuda/step.h",
        "point - hot.vec(i), point - hot.vec(j),",
        "point - hot.vec(j), point - hot.vec(i),",
        KERNELS + "[H]",
    ),
    mutation(
        "gpu-force-on-the-other-with-its-sign",
        "cuda/step.h",
        "at_lever(second ? -force : force, lever)",
        "at_lever(force, lever)",
        KERNELS + "[H]",
    ),
    mutation(
        "gpu-history-outlives-the-contact",
        "cuda/step.h",
        "if (touched) memory.forget(), touching = 0;",
        "if (touched) touching = 0;",
        KERNELS + "[H]",
    ),
    mutation(
        "gpu-contact-outlives-its-end",
        "cuda/step.h",
        "if (touched) memory.forget(), touching = 0;",
        "if (touched) memory.forget();",
        KERNELS + "[H]",
    ),
    mutation(
        "gpu-outermost-ring-lost",
        "cuda/step.h",
        "if (outer >= 0) layers.rim = ring(outer);",
        "",
        KERNELS + "[M2-averaged]",
    ),
    mutation(
        "gpu-walls-outlive-their-touch",
        "cuda/step.h",
        "if (!rubs && touches != static_cast<bool>(touching)) touching = touches;",
        "if (touches) touching = 1;",
        KERNELS + "[spheres]",
    ),
    mutation(
        "gpu-image-of-the-lever",
        "cuda/step.h",
        "if (second) lever = lever - on.cell(step)",
        "if (false) lever = lever - on.cell(step)",
        KERNELS + "[periodic-H]",
    ),
    mutation(
        "gpu-pressure-of-the-first-chunk",
        "cuda/handler.cc",
        "stride < spheres; stride *= kChunk",
        "stride < 2; stride *= kChunk",
        KERNELS + "[H]",
    ),
    mutation(
        "gpu-adjoint-history-bar-outlives-the-contact",
        "cuda/back.h",
        "return bars.put(at, 0.0);",
        "return bars.put(at, bars[at]);",
        BACK + "[H]",
    ),
    mutation(
        "gpu-adjoint-of-the-other-force-lost",
        "cuda/back.h",
        "on_grain(i, kMidForce) - on_grain(j, kMidForce)",
        "on_grain(i, kMidForce)",
        BACK + "[H]",
    ),
    mutation(
        "gpu-adjoint-of-the-lever-at-the-centre-lost",
        "cuda/back.h",
        "second ? point + separation : point - separation",
        "second ? separation : -separation",
        BACK + "[H]",
    ),
    mutation(
        "gpu-adjoint-of-pressures-lost",
        "cuda/back.h",
        "pull_back<WallPressure>(of_pressure, pressure_bar, pressure_gives);",
        "store_vec(force_bar, Vec<double>{});",
        BACK + "[M1]",
    ),
    mutation(
        "gpu-adjoint-sums-the-first-chunk",
        "cuda/handler.cc",
        "stride < most; stride *= kChunk",
        "stride < 2; stride *= kChunk",
        BACK + "[H]",
    ),
    mutation(
        "gpu-adjoint-of-a-double-divides-by-zero",
        "program.h",
        "zero_unless(a > 0.0, inverse_root(a))",
        "inverse_root(a)",
        BACK + "[H]",
    ),
    mutation(
        "gpu-list-taken-on-trust",
        "native/cuda.py",
        " & (listed == spheres)",
        "",
        "test_a_broken_list_gives_no_numbers",
    ),
    # ---------------------------------------------------------------- analysis and signals
    mutation(
        "gain-without-scale",
        "experiment/analysis.py",
        "template = scale * integral\n    gain",
        "template = integral\n    gain",
        "test_a_scaled_integral_is_a_perfect_memory",
    ),
    mutation(
        "fidelity-squared",
        "experiment/analysis.py",
        "1.0 - jnp.sqrt(miss / jnp.sum(signal * signal))",
        "1.0 - miss / jnp.sum(signal * signal)",
        "test_fidelity_is_one_minus_the_sine_of_the_angle_to_the_template",
    ),
    mutation(
        "readout-not-turned",
        "experiment/analysis.py",
        "jnp.flip(pressure[:, 0] - pressure[:, 1], axis=0).T",
        "(pressure[:, 0] - pressure[:, 1]).T",
        "test_a_readout_is_turned_to_ascending_u",
    ),
    mutation(
        "background-line-of-one-end",
        "experiment/analysis.py",
        "signal - (signal[:, :1] * (1.0 - ramp) + signal[:, -1:] * ramp)",
        "signal - signal[:, -1:] * ramp",
        "test_backgrounds_subtract_what_they_say",
    ),
    mutation(
        "backgrounds-not-averaged",
        "experiment/analysis.py",
        "integral, scale, window) for name",
        "integral, scale, None) for name",
        "test_averaging_over_a_window_removes_what_rings_in_it_from_every_background",
    ),
    mutation(
        "words-count-with-their-ringing",
        "reproduce/compare.py",
        "(row[gain], row[fidelity]) for name",
        '(row["gain"], row["fidelity"]) for name',
        "test_so_do_words_by_every_background",
    ),
    mutation(
        "running-mean-window",
        "experiment/analysis.py",
        "low = jnp.clip(centre - 0.5 * width",
        "low = jnp.clip(centre - 0.4 * width",
        MEAN,
    ),
    mutation(
        "running-mean-edges",
        "experiment/analysis.py",
        "/ (high - low)",
        "/ width",
        MEAN,
    ),
    mutation(
        "running-mean-last-bin",
        "experiment/analysis.py",
        ".astype(jnp.int32), 0, bins - 1)",
        ".astype(jnp.int32), 0, bins - 2)",
        MEAN,
    ),
    mutation(
        "bump-too-narrow",
        "experiment/signals.py",
        "jnp.abs(x) < 0.5",
        "jnp.abs(x) < 0.45",
        "test_the_integral_is_the_integral_of_the_shear",
    ),
    mutation(
        "integral-not-from-zero",
        "experiment/signals.py",
        "primitive(u) - primitive(jnp.zeros_like(u))",
        "primitive(u)",
        "test_a_bump_cut_by_the_end_of_the_range_integrates_from_zero",
    ),
    mutation(
        "bins-sampled",
        "experiment/signals.py",
        "jnp.mean(signals.integral(u).reshape(BINS, POINTS, -1), axis=1).T",
        "signals.integral(u).reshape(BINS, POINTS, -1)[:, POINTS // 2].T",
        "test_bins_hold_the_average_of_the_integral_not_its_samples",
    ),
    mutation(
        "words-from-the-last-bit",
        "experiment/signals.py",
        "places = np.arange(bits - 1, -1, -1)",
        "places = np.arange(bits)",
        "test_there_are_two_to_the_bits_words_most_significant_bit_first",
    ),
    # ---------------------------------------------------------------- the experiment: stages, walls, walks
    mutation(
        "hold-for-rest",
        "experiment/protocols.py",
        'Stage("rest-2", 0.0, 0.0, rest, "hold")',
        'Stage("rest-2", 0.0, 0.0, hold, "hold")',
        "test_rests_holds_and_storage_have_lengths_of_their_own",
    ),
    mutation(
        "rest-for-hold",
        "experiment/stages.py",
        'Stage("hold", to, to, hold, "hold")',
        'Stage("hold", to, to, rest, "hold")',
        "test_rests_holds_and_storage_have_lengths_of_their_own",
    ),
    mutation(
        "bins-rounded-down",
        "simulation/stage.py",
        "math.ceil(self.length * BINS - 1e-9)",
        "math.floor(self.length * BINS + 1e-9)",
        "test_a_hold_that_is_not_whole_bins_is_rounded_up_to_them",
    ),
    mutation(
        "store-sheared",
        "experiment/protocols.py",
        'Stage("store", 1.0, 1.0, store, "hold")',
        'Stage("store", 1.0, 1.0, store, "hold", OWN)',
        "test_only_the_encoding_is_sheared_and_all_before_it_is_common",
    ),
    mutation(
        "readout-sheared",
        "experiment/protocols.py",
        'Stage("readout", 1.0, 0.0, 1.0, "read")',
        'Stage("readout", 1.0, 0.0, 1.0, "read", OWN)',
        "test_only_the_encoding_is_sheared_and_all_before_it_is_common",
    ),
    mutation(
        "gamma-on-each-axis",
        "simulation/strain.py",
        "share: Scalar = 0.5",
        "share: Scalar = 1.0",
        "test_half_of_gamma_goes_to_each_axis_with_opposite_signs",
    ),
    mutation(
        "compression-of-each-axis",
        "simulation/strain.py",
        "squeeze = 1.0 - (1.0 - jnp.sqrt(1.0 - self.delta0)) * u",
        "squeeze = 1.0 - self.delta0 * u",
        "test_full_compression_takes_delta0_of_the_area_and_nothing_of_the_height",
    ),
    mutation(
        "walls-a-step-late",
        "simulation/loop.py",
        "row.number * steps + 1 + jnp.arange(steps)",
        "row.number * steps + jnp.arange(steps)",
        "test_the_samples_of_a_run_follow_the_table",
    ),
    mutation(
        "drag-under-moving-walls",
        "simulation/loop.py",
        "jnp.where(jnp.asarray(row.still, bool), simulation.drag, 0.0)",
        "jnp.asarray(simulation.drag)",
        "test_only_while_the_walls_stand_still_is_there_a_drag",
    ),
    mutation(
        "pulse-at-one-u",
        "simulation/strain.py",
        "jnp.where(row.timed, passed, u)",
        "u",
        "test_where_u_stands_still_the_waveform_runs_in_time",
    ),
    mutation(
        "pulse-and-encoding-sheared",
        "experiment/protocols.py",
        "() if pulsed else OWN)",
        "OWN)",
        "test_a_pulse_before_the_compression_takes_the_shear_from_it",
    ),
    mutation(
        "channel-of-the-opposite-stress",
        "simulation/channels.py",
        "-2.0 * part * pressure",
        "2.0 * part * pressure",
        "test_a_channel_strains_the_box_by_its_mode_and_reads_the_stress_of_it",
    ),
    mutation(
        "zero-signal-without-fixed-waveforms",
        "simulation/strain.py",
        "if not self.lanes[lane].drive.fixed:",
        "if True:",
        "test_friction_drag_and_fixed_waveforms_are_those_of_the_stage",
    ),
    mutation(
        "servo-away-from-its-pressure",
        "simulation/strain.py",
        "1.0), SERVO_GAIN,",
        "1.0), -SERVO_GAIN,",
        "test_held_walls_come_to_the_pressure_and_give_way",
    ),
    mutation(
        "friction-never-off",
        "simulation/loop.py",
        '"mu", law.mu * row.friction',
        '"mu", law.mu',
        "test_friction_drag_and_fixed_waveforms_are_those_of_the_stage",
    ),
    mutation(
        "weights-in-frames",
        "simulation/frames.py",
        "map_numbers(of_one, simulation.system.friction, deeper=to_host)",
        "jax.tree.map(of_one, simulation.system.friction)",
        "test_weights_of_a_law_are_shared_by_all_replicas",
    ),
    mutation(
        "weights-in-stable-steps",
        "experiment/stepping.py",
        "map_numbers(twice, law)",
        "jax.tree.map(twice, law)",
        "test_weights_of_a_law_are_shared_by_all_replicas",
    ),
    mutation(
        "laws-always-made-anew",
        "pytree.py",
        "anew = is_dataclass(made) and all(entry.name in taken for entry in fields(whole) if entry.init)",
        "anew = is_dataclass(made)",
        "test_a_law_need_not_take_its_own_fields_to_be_given_another_mu",
    ),
    mutation(
        "names-taken-twice",
        "derivatives/gradient.py",
        "on.observers = (prefix,) if any(map(acts_on_prefix, theta)) else ()",
        "on.observers = (prefix,) if any(map(acts_on_prefix, by)) else ()",
        "test_names_may_come_one_by_one",
    ),
    mutation(
        "reads-in-time-drawn-over-u",
        "experiment/recall.py",
        "return not any(stage.moves for stage in self.protocol if stage.name in self.reads)",
        "return False",
        "test_a_shear_to_one_side_stays_there_and_returns",
    ),
    mutation(
        "observed-forces-a-step-ahead",
        "simulation/observables.py",
        "jnp.asarray(simulation.dt) if ahead",
        "jnp.asarray(simulation.dt) if True",
        "test_powers_add_up_to_the_energy_that_a_collision_takes[law0]",
    ),
    mutation(
        "stress-without-the-arms-at-walls",
        "simulation/observables.py",
        "total = _tensor(push, branch) + _tensor(upper - lower, arms)",
        "total = _tensor(push, branch)",
        "test_the_stress_of_contacts_is_that_of_the_walls_and_of_accelerations",
    ),
    mutation(
        "rotation-of-the-other-sign",
        "simulation/observables.py",
        "jnp.abs(dot(now, then))",
        "dot(now, then)",
        "test_a_known_rotation_is_found_whatever_the_sign_of_its_quaternions[-1.0]",
    ),
    mutation(
        "observers-without-the-drag-of-the-stage",
        "simulation/loop.py",
        "system=system, path=path, dt=dt, drag=drag, box=last",
        "system=system, path=path, dt=dt, box=last",
        "test_observers_know_the_drag_and_the_friction_of_a_stage",
    ),
    mutation(
        "compared-with-the-first-write",
        "simulation/protocol.py",
        "for stage in before for drive in stage.own}",
        "for stage in before[::-1] for drive in stage.own}",
        "test_each_read_is_compared_with_what_was_written_last",
    ),
    mutation(
        "channels-fitted-apart",
        "experiment/analysis.py",
        "products = template @ template.T",
        "products = jnp.diag(jnp.diag(template @ template.T))",
        "test_cross_talk_is_found_where_it_was_put",
    ),
    mutation(
        "chunk-redone-on-the-stale-list",
        "simulation/runner.py",
        "self.renew(self.simulation.box_before(chunk.row, chunk.state.servo))",
        "pass",
        "test_a_list_that_goes_stale_is_rebuilt_and_its_chunk_redone_with_the_same_result",
    ),
    mutation(
        "list-foreseen-too-late",
        "simulation/runner.py",
        "(1.0 + count / self._lasted) > self.skin",
        "1.0 > self.skin",
        "test_a_runner_that_foresees_throws_no_chunk_away",
    ),
    mutation(
        "slow-grains-taken-for-unstable-steps",
        "simulation/runner.py",
        "(LARGEST_SKIN if speed < FAST else WIDE_SKIN)",
        "WIDE_SKIN",
        "test_grains_that_fly_far_in_a_long_bin_break_a_run_only_if_they_are_fast",
    ),
    mutation(
        "stale-chunk-stands",
        "simulation/runner.py",
        "            self._renew_stale(chunk, float(np.max(to_host(sample.largest_speed))))\n            return\n",
        "            status &= ~int(Status.STALE_PAIRS)\n",
        "test_a_list_that_goes_stale_is_rebuilt_and_its_chunk_redone_with_the_same_result",
    ),
    mutation(
        "histories-forgotten-at-renewal",
        "simulation/runner.py",
        "history=move(self.state.history, blank)",
        "history=blank",
        "test_a_list_that_goes_stale_is_rebuilt_and_its_chunk_redone_with_the_same_result",
    ),
    mutation(
        "progress-of-bins",
        "simulation/runner.py",
        "self.work += bins * work_of_bin(self.state.replicas)",
        "self.work += bins",
        "test_the_samples_of_a_run_follow_the_table",
    ),
    mutation(
        "list-not-resumed",
        "simulation/runner.py",
        'listed = self.simulation.with_pairs(snapshot["pairs"])',
        "listed = self.simulation",
        "test_a_run_goes_on_with_the_lists_it_had",
    ),
    mutation(
        "bins-done-again",
        "simulation/runner.py",
        'samples.restore(saved["samples"])',
        "pass",
        "test_a_run_goes_on_with_the_lists_it_had",
    ),
    mutation(
        "way-back-from-the-end",
        "derivatives/gradient.py",
        "                del way.tape[left:]\n",
        "",
        "test_the_way_back_goes_on",
    ),
    mutation(
        "checkpoint-of-a-failure",
        "files/checkpoints.py",
        "            checkpoint.discard()  # it would fail again: the next run must change something\n",
        "",
        "test_a_run_that_failed_leaves_nothing_to_go_on_from",
    ),
    mutation(
        "sweep-begun-anew",
        "sweeps/sweep.py",
        "jobs = begun + [",
        "jobs = [",
        "test_runs_that_were_begun_go_on_as_they_were",
    ),
    mutation(
        "parts-of-a-living-worker-removed",
        "sweeps/store.py",
        ' and not self.taken({"name": name}):',
        ":",
        "test_what_a_living_worker_has_is_left_to_it",
    ),
    mutation(
        "packs-of-a-sweep-cycled-as-ever",
        "sweeps/making.py",
        "for name in FOLLOW if follow and",
        "for name in () if follow and",
        "test_what_belongs_to_the_preparation_follows_into_it",
    ),
    mutation(
        "cpus-that-srun-is-not-told",
        "sweeps/executors.py",
        'return told if known else [*told, f"--cpus-per-task={cpus}"]',
        "return told",
        "test_a_worker_of_slurm_gets_the_cpus_that_its_job_asks_for",
    ),
    mutation(
        "two-parameters-in-one-mean",
        "sweeps/curves.py",
        "over = [name for name in free if is_sample(name)]",
        "over = free",
        "test_a_parameter_has_a_line_and_samples_have_a_mean_unless_it_is_said_otherwise",
    ),
    mutation(
        "keys-as-jax-is-told",
        "physics/chance.py",
        "impl=_GENERATOR)",
        'impl="threefry2x32")',
        "test_a_seed_gives_the_same_pack_and_net_under_any_setting_of_jax",
    ),
    mutation(
        "deaths-on-the-way-counted",
        "sweeps/executors.py",
        "deaths, furthest = 0, now",
        "furthest = now",
        "test_workers_may_die_as_often_as_each_gets_farther",
    ),
    mutation(
        "bound-without-what-is-no-number",
        "single.h",
        "return a != a || a > b ? a : b;",
        "return __builtin_fmax(a, b);",
        "test_unit_tests_in_cpp[numbers]",
    ),
    mutation(
        "prefix-of-another-point",
        "experiment/several.py",
        "place = side.prefix[owners] if",
        "place = 0 * side.prefix[owners] if",
        "test_points_side_by_side_are_the_points_alone",
    ),
    mutation(
        "defaults-lost-side-by-side",
        "experiment/several.py",
        "for each in experiments for name in replica_parameters(each)",
        "for name in replica_parameters(experiments[0])",
        "test_points_side_by_side_are_the_points_alone",
    ),
    mutation(
        "zero-signal-of-another-point",
        "experiment/several.py",
        "numbers += [0, *(begun",
        "numbers += [1, *(begun",
        "test_points_side_by_side_are_the_points_alone",
    ),
    mutation(
        "key-without-the-pack",
        "experiment/record.py",
        'own = {**to_dict(experiment), "pack": pack_fingerprint(experiment.pack)}',
        'own = {**to_dict(experiment), "pack": ""}',
        "test_a_key_stands_for_all_that_numbers_depend_on",
    ),
    mutation(
        "key-without-the-code-of-a-law",
        "experiment/record.py",
        'own["law"] = identity(experiment.friction)',
        'own["law"] = ""',
        "test_another_formula_or_number_of_a_law_is_another_law",
    ),
    mutation(
        "key-without-the-code-of-observers",
        "experiment/record.py",
        "(name, identity(reduce)) for",
        '(name, "") for',
        "test_an_observer_that_gives_something_else_is_another",
    ),
    mutation(
        "side-by-side-whatever-the-law",
        "experiment/several.py",
        "laws = [identity(_alike(each))",
        "laws = [type(each.friction).__name__",
        "test_laws_of_one_name_or_with_other_inner_numbers_do_not_run_side_by_side",
    ),
    mutation(
        "parts-of-any-waveforms-by-rows",
        "experiment/signals.py",
        "elif type(one) in (Bumps, Spline):",
        "elif True:",
        "test_a_part_of_waveforms_of_one_s_own_has_their_numbers",
    ),
    mutation(
        "kernel-of-another-shear",
        "design/kernel.py",
        "float(experiment.gamma0) * experiment.protocol.written(read)[channel].amplitude",
        "float(experiment.gamma0)",
        "test_a_kernel_is_that_of_the_shear_that_the_stage_writes_and_of_the_bins_that_are_read",
    ),
    mutation(
        "kernel-of-bins-that-are-not-read",
        "design/kernel.py",
        "seen | ~seen.any()",
        "seen | True",
        "test_a_kernel_is_that_of_the_shear_that_the_stage_writes_and_of_the_bins_that_are_read",
    ),
    mutation(
        "jacobian-with-one-zero-signal",
        "derivatives/jacobian.py",
        "[k, half + k]",
        "[0, half + k]",
        "test_the_jacobian_is_of_what_the_protocol_reads[stages1]",
    ),
    mutation(
        "report-without-the-rules",
        "command/app.py",
        'self.name == "info" and "jax" not in',
        'self.name in ("info", "report") and "jax._src.interpreters.none" not in',
        "test_the_command_by_itself_reports_what_depends_on_its_rules",
    ),
    mutation(
        "key-without-what-a-decorator-adds",
        "experiment/identity.py",
        'hasattr(value, "__wrapped__") and not _is_own_function(value)',
        'hasattr(value, "__wrapped__")',
        "test_what_holds_or_wraps_the_code_of_the_users_own_is_told_by_it[what a decorator adds]",
    ),
    mutation(
        "key-without-the-class-of-a-tuple",
        "experiment/identity.py",
        "isinstance(value, _PLAIN + _HOLDING)",
        "isinstance(value, _PLAIN)",
        "test_what_holds_or_wraps_the_code_of_the_users_own_is_told_by_it[a named tuple]",
    ),
    mutation(
        "kernel-in-a-set-called-xy",
        "design/kernel.py",
        "signals(**{one: loud if one == name else silent for one in experiment.sets})",
        "loud",
        "test_a_kernel_and_a_design_are_of_a_set_of_any_name",
    ),
    mutation(
        "one-window-for-all-reads",
        "experiment/readings.py",
        "window * self.rates",
        "window * np.ones_like(self.rates)",
        "test_a_read_is_averaged_over_what_it_goes_through_in_a_ringing_period",
    ),
    mutation(
        "padding-of-zero",
        "simulation/sharding.py",
        "more = np.repeat(leaf[..., :1], self.padded",
        "more = np.nan * np.repeat(leaf[..., :1], self.padded",
        "test_eight_devices_give_the_numbers_of_one",
    ),
    mutation(
        "at-rest-too-soon",
        "experiment/recall.py",
        "REST_SPEED = 0.01",
        "REST_SPEED = 0.1",
        "test_a_replica_is_not_at_rest_from_one_per_cent_of_the_walls_speed_on",
    ),
    mutation(
        "at-rest-when-storage-begins",
        "experiment/recall.py",
        "stages[experiment.protocol.before_read].largest_speed[-1]",
        "stages[experiment.protocol.before_read].largest_speed[0]",
        "test_a_replica_is_not_at_rest_from_one_per_cent_of_the_walls_speed_on",
    ),
    mutation(
        "speed-of-both-walls",
        "experiment/validity.py",
        "return 0.5 * (pack.upper - pack.lower)",
        "return 1.0 * (pack.upper - pack.lower)",
        "test_a_replica_is_not_at_rest_from_one_per_cent_of_the_walls_speed_on",
    ),
    mutation(
        "unrest-of-a-moment",
        "experiment/validity.py",
        "jnp.quantile(sample.largest_speed, 0.75, axis=0)",
        "jnp.max(sample.largest_speed, axis=0)",
        "test_one_fast_moment_is_not_unrest",
    ),
    mutation(
        "no-signal-is-no-noise",
        "experiment/validity.py",
        "noise >= LARGEST_NOISE",
        "(noise >= LARGEST_NOISE) & jnp.isfinite(noise)",
        "test_each_doubt_is_that_of_its_replica_alone",
    ),
    mutation(
        "tangent-of-offsets-lost",
        "cpu/block.h",
        "if (deforms) return function(offsets);",
        "if (deforms) return function(block.pack->offsets);",
        "test_modes_agree_with_plain_jax[H-True-True]",
    ),
    mutation(
        "adjoint-of-offsets-of-the-first-chunk",
        "cpu/adjoint.h",
        "chunk < chunks(); ++chunk) of_offset",
        "chunk < 1; ++chunk) of_offset",
        "test_modes_agree_with_plain_jax[H-True-True]",
    ),
    mutation(
        "adjoint-of-the-box-before-lost",
        "cpu/adjoint.h",
        "earlier_bar[q] += cell_bar_of_chunk(chunk)[kCellNumbers + q];",
        "",
        IN_A_PERIODIC_BOX + "[H-xyz]",
    ),
    mutation(
        "adjoint-of-images-not-moved",
        "physics/contact.h",
        "  m.lever_one = m.lever_one + half;\n",
        "",
        IN_A_PERIODIC_BOX + "[H-xyz]",
    ),
    mutation(
        "adjoint-of-sections-without-mass",
        "cpu/adjoint.h",
        "seed(parameter.row[kMass], *bar++);",
        "++bar;",
        IN_A_PERIODIC_BOX + "[H-xyz]",
    ),
    mutation(
        "adjoint-of-unequal-spheres-on-walls",
        "physics/calculations.h",
        "parameters.wall_stiffness = root(radius) * parameters.wall_stiffness;",
        "",
        "test_the_adjoint_of_unequal_spheres_is_the_transpose_of_their_tangent[H-spheres]",
        AT_ROUGH_WALLS + "[H-file2]",
    ),
    mutation(
        "adjoint-of-rough-walls-remembers-later-steps",
        "cpu/adjoint.h",
        "else if (known.ever >> w & 1) std::fill_n(now, Law::kHistory, V{});",
        "",
        AT_ROUGH_WALLS + "[H-file0]",
    ),
    mutation(
        "adjoint-of-rough-walls-that-let-go",
        "cpu/adjoint.h",
        "return void(std::fill_n(history_bar, remembered(problem), V{}));",
        "return;",
        AT_ROUGH_WALLS + "[H-file0]",
    ),
    mutation(
        "second-adjoint-of-bars-that-stay",
        "cpu/adjoint.h",
        "return {of(block.bars), of(block.bar_slopes)};",
        "return {of(block.bars), Real{}};",
        "test_the_adjoint_is_the_transpose_of_the_tangent[H-True]",
    ),
    mutation(
        "second-adjoint-of-rings-without-slopes",
        "cpu/adjoint.h",
        "part < kParts; ++part",
        "part < 1; ++part",
        "test_the_adjoint_is_the_transpose_of_the_tangent[M2-exact-True]",
    ),
    mutation(
        "second-adjoint-of-offsets-that-stay",
        "cpu/adjoint.h",
        "return load_vec(forward.offsets + 3 * k);",
        "return body_at<V>(block.pack->offsets + 3 * k);",
        "test_the_adjoint_is_the_transpose_of_the_tangent[H-True]",
    ),
    mutation(
        "second-adjoint-of-bars-for-their-slopes",
        "native/primitives.py",
        "fixed, arrays, along, slopes, changes)",
        "fixed, arrays, along, slopes, slopes)",
        "test_the_adjoint_is_the_transpose_of_the_tangent[H-True]",
        "test_all_ways_to_a_second_derivative_agree",
    ),
    mutation(
        "second-adjoint-transposed-without-changes",
        "native/primitives.py",
        "found = [*by_along, *jax.tree.leaves(on_results), *by_changes]",
        "found = [*by_along, *jax.tree.leaves(on_results), *jax.tree.leaves(_still(on_results))]",
        "test_all_ways_to_a_second_derivative_agree",
    ),
    mutation(
        "walls-of-pieces-as-they-are-gone-back-through",
        "native/primitives.py",
        "jnp.concatenate(walls[::-1], axis=-3)",
        "jnp.concatenate(walls, axis=-3)",
        "test_the_adjoint_is_the_transpose_of_the_tangent[H-True]",
    ),
    mutation(
        "adjoint-of-rings-in-periodic-boxes",
        "cpu/adjoint.h",
        "if (general) move_to_image(input, taped_image, taped_cell);",
        "",
        IN_A_PERIODIC_BOX + "[M2-xyz]",
    ),
    mutation(
        "gpu-tangent-of-offsets-lost",
        "cuda/step.h",
        "a.along_offsets.of(entry)[row * a.replicas + replica]",
        "0.0",
        KERNELS + "[H]",
    ),
    mutation(
        "length-of-quaternions-counts",
        "physics/rotation.py",
        "return quaternion * (scale + jax.lax.stop_gradient(rest))",
        "return quaternion * (scale + rest)",
        "test_the_length_of_a_quaternion_has_no_derivative_and_its_direction_has",
    ),
    mutation(
        "history-left-where-nothing-touches",
        "contact/own_law.py",
        "force, left = tried(-0.1, used)",
        "force, left = tried(-0.1, blank)",
        "test_a_law_that_returns_something_else_is_refused_by_name_when_an_experiment_is_made",
    ),
    mutation(
        "times-without-stages-that-are-not-recorded",
        "simulation/sample.py",
        "if begins is None else map(begins.__getitem__, stages)",
        "",
        "test_times_count_stages_that_were_not_recorded",
    ),
    mutation(
        "other-waveforms-written-as-bumps",
        "experiment/record.py",
        "if known is type(signals)), None)",
        "if isinstance(signals, known)), None)",
        "test_waveforms_of_another_formula_are_others",
    ),
    mutation(
        "order-of-slopes-of-bumps",
        "command/derive.py",
        "rows.append((place[real][order], slope[real][order]))",
        "rows.append((place[real][order], slope[real]))",
        "test_slopes_of_bumps_are_in_the_order_of_their_places",
    ),
    mutation(
        "overlap-range-too-wide",
        "simulation/sample.py",
        "deepest > largest_overlap(",
        "deepest > 1.01 * largest_overlap(",
        "test_an_overlap_beyond_the_range_of_the_law_is_flagged_by_replica",
    ),
    mutation(
        "overlap-range-too-narrow",
        "simulation/sample.py",
        "deepest > largest_overlap(",
        "deepest > 0.99 * largest_overlap(",
        "test_an_overlap_beyond_the_range_of_the_law_is_flagged_by_replica",
    ),
    mutation(
        "broken-by-choice",
        "experiment/recall.py",
        "p_sig = sound * found",
        "p_sig = jnp.where(sound == 1.0, found, sound)",
        "test_a_broken_run_has_no_gradient_either",
    ),
    mutation(
        "broken-but-a-number",
        "experiment/recall.py",
        "jnp.nan, 1.0)",
        "1.0, 1.0)",
        "test_what_is_traced_sets_a_fatal_bit_and_turns_all_into_nan[gamma0]",
    ),
    mutation(
        "impossible-on-top-only",
        "physics/pytree.py",
        "if is_dataclass(within):",
        "if False:",
        "test_what_is_traced_sets_a_fatal_bit_and_turns_all_into_nan[mu]",
    ),
    mutation(
        "step-too-large-unnoticed",
        "experiment/experiment.py",
        "jnp.asarray(self.timing.dt) <= LONGEST_STEP)",
        "jnp.asarray(self.timing.dt) <= 2.0 * LONGEST_STEP)",
        "test_a_step_too_large_for_a_traced_run_gives_nan_and_says_so",
    ),
    mutation(
        "gain-without-gamma0",
        "experiment/experiment.py",
        "scale = self.compression * self.gamma0",
        "scale = self.compression",
        "test_gain_and_fidelity_follow_their_definitions",
    ),
    mutation(
        "last-signal-for-the-zero-signal",
        "experiment/run.py",
        "np.asarray(other)[..., 1:]",
        "np.asarray(other)[..., :-1]",
        "test_batches_are_one_run_and_can_be_resumed",
    ),
    # ---------------------------------------------------------------- derivatives
    mutation(
        "tangent-forgotten-at-renewal",
        "derivatives/push.py",
        "move(history, jax.tree.map(jnp.zeros_like, blank))",
        "jax.tree.map(jnp.zeros_like, blank)",
        "test_derivatives_do_not_mind_lists_that_are_made_anew[friction.mu]",
    ),
    mutation(
        "cotangent-forgotten-at-renewal",
        "derivatives/gradient.py",
        "(slope[0], pull(slope[1])[0], *slope[2:])",
        "(slope[0], jax.tree.map(jnp.zeros_like, history), *slope[2:])",
        "test_derivatives_do_not_mind_lists_that_are_made_anew[friction.mu]",
    ),
    mutation(
        "second-readout-not-pulled",
        "derivatives/gradient.py",
        "self.reads.get(chunk.stage.name)",
        'self.reads.get(chunk.stage.name.replace("readout-2", ""))',
        "test_a_second_readout_as_background_is_differentiated_too",
    ),
    mutation(
        "prefix-not-differentiated",
        "experiment/experiment.py",
        'not any(entry.name == first and entry.metadata.get("after_prefix") for entry in fields(Experiment))',
        "False",
        "test_what_acts_on_the_prefix_is_recognised",
    ),
    # ---------------------------------------------------------------- preparation
    mutation(
        "ringing-peak",
        "preparation/ringing.py",
        "return padded * spacing /",
        "return 0.7 * padded * spacing /",
        "test_the_peak_of_one_oscillation_is_its_period",
    ),
    mutation(
        "ringing-between-points",
        "preparation/ringing.py",
        "(peak + 0.5 * (below - above)",
        "(peak + 0.0 * (below - above)",
        "test_the_peak_of_one_oscillation_is_its_period",
    ),
    mutation(
        "ringing-drift",
        "preparation/ringing.py",
        "power[: PERIODS * 16] = 0.0",
        "power[:1] = 0.0",
        "test_drift_is_not_taken_for_ringing",
    ),
    mutation(
        "ringing-unit",
        "preparation/ringing.py",
        "pressure[:, 1], STEPS_PER_SAMPLE * float(dt), shortest)",
        "pressure[:, 1], 0.7 * STEPS_PER_SAMPLE * float(dt), shortest)",
        "test_two_spheres_between_two_walls_ring_at_the_rate_of_their_springs",
    ),
    mutation(
        "gas-speed",
        "preparation/preparation.py",
        "recipe.gas_speed / math.sqrt(3.0)",
        "recipe.gas_speed",
        GAS,
    ),
    mutation(
        "gas-spins-like-velocities",
        "preparation/preparation.py",
        "scale * jax.random.normal(spin_key, shape)",
        "scale * jax.random.normal(velocity_key, shape)",
        GAS,
    ),
    mutation(
        "gas-without-spins",
        "preparation/preparation.py",
        "scale * jax.random.normal(spin_key, shape)",
        "0.0 * jax.random.normal(spin_key, shape)",
        GAS,
    ),
    mutation(
        "gas-too-thick",
        "preparation/recipe.py",
        "LATTICE_SPACING = 1.02",
        "LATTICE_SPACING = 0.9",
        "test_the_gas_starts_as_thin_as_the_recipe_says_and_never_thicker_than_grains_that_turn_freely",
    ),
    mutation(
        "lattice",
        "preparation/recipe.py",
        "DENSE = 0.72",
        "DENSE = 0.64",
        "test_lattices_are_those_of_the_paper",
    ),
    mutation(
        "box-of-long-grains",
        "preparation/recipe.py",
        "np.array([cube / side, cube / side, least])",
        "np.full(3, least)",
        "test_long_grains_stand_so_that_their_pressed_pack_will_be_a_cube",
    ),
    mutation(
        "pieces-of-a-fast-cycle",
        "preparation/preparation.py",
        "stepping(max(recipe.t0, SLOWEST_BINS), recipe.dt)",
        "stepping(recipe.t0, recipe.dt)",
        "test_a_preparation_costs_no_more_when_its_cycles_are_faster",
    ),
    mutation(
        "piston-settles-in-motion",
        "preparation/piston.py",
        "met & (fastest < servo.quiet)",
        "met",
        PISTON,
    ),
    mutation(
        "piston-settles-off-its-pressure",
        "preparation/piston.py",
        "- 1.0)) < servo.error",
        "- 1.0)) < 2.0 * servo.error",
        PISTON,
    ),
    mutation(
        "piston-without-a-speed-limit",
        "simulation/strain.py",
        "- 1.0), -fastest, fastest)",
        "- 1.0), -fastest, 9.0)",
        "test_the_piston_moves_with_the_error_of_the_pressure_at_most_at_its_speed",
    ),
    mutation(
        "settling-in-motion",
        "preparation/preparation.py",
        "quiet=recipe.settled_speed",
        "quiet=1e3 * recipe.settled_speed",
        "test_a_pack_ends_at_rest_under_its_pressure",
    ),
    mutation(
        "rest-in-motion",
        "preparation/preparation.py",
        "speed <= recipe.quiet:",
        "speed <= 1e2 * recipe.quiet:",
        "test_a_pack_ends_at_rest_under_its_pressure",
    ),
    # ---------------------------------------------------------------- reading
    mutation(
        "noise-of-a-neighbour",
        "reading/lessons.py",
        "number = word * lessons.combinations + combination",
        "number = word + combination",
        "test_no_two_examples_have_the_same_noise",
    ),
    mutation(
        "quick-check-of-few",
        "reading/lessons.py",
        "self.lessons.classes + 7 * word)",
        "self.lessons.classes + 0 * word)",
        "test_a_quick_check_takes_other_combinations_for_every_word",
    ),
    mutation(
        "held-out-stride",
        "reading/lessons.py",
        "self.lessons.classes + 7 * word)",
        "self.lessons.classes + 1 * word)",
        "test_a_quick_check_takes_other_combinations_for_every_word",
    ),
    mutation(
        "amplitude-stride",
        "reading/lessons.py",
        "jnp.divmod(combination, lessons.amplitudes * lessons.draws)",
        "jnp.divmod(combination, lessons.shifts * lessons.draws)",
        "test_an_example_is_a_shifted_scaled_word_plus_noise_of_its_rung",
    ),
    mutation(
        "trained-on-what-is-held-out",
        "reading/lessons.py",
        "(lessons.batch,), lessons.kept, lessons.combinations)",
        "(lessons.batch,), 0, lessons.combinations)",
        "test_held_out_combinations_are_never_trained_on",
    ),
    mutation(
        "template-by-product",
        "reading/readers.py",
        "return np.asarray(array / np.linalg.norm(array, axis=1, keepdims=True))",
        "return array",
        "test_the_nearest_template_is_found_whatever_its_size",
    ),
    mutation(
        "ridge-sees-all",
        "reading/readers.py",
        "others = np.setdiff1d(order, part)",
        "others = order",
        "test_the_linear_decoder_never_sees_the_word_it_reads",
    ),
    mutation(
        "confusion-turned",
        "reading/readers.py",
        "(np.tile(np.arange(count), len(answers)), answers.ravel())",
        "(answers.ravel(), np.tile(np.arange(count), len(answers)))",
        "test_confusion_counts_rows_of_stored_and_columns_of_read_words",
    ),
    # ---------------------------------------------------------------- files
    mutation(
        "half-a-file-stays",
        "files/atomic.py",
        "            drop(made)\n",
        "            pass\n",
        "test_a_failed_write_leaves_nothing_behind",
    ),
    mutation(
        "mass-of-a-larger-sphere",
        "files/lammpsdata.py",
        "volume = 4.0 * np.pi / 3.0 * radii**3",
        "volume = 4.0 * np.pi / 3.0 * radii**0",
        "test_free_particles_are_grains_of_their_own_of_the_density_they_have",
    ),
    mutation(
        "wrong-kind-taken",
        "experiment/arguments.py",
        "    if not isinstance(value, kind):\n",
        "    if value is None:\n",
        "test_what_is_no_experiment_is_not_run",
    ),
    mutation(
        "any-schema",
        "files/hdf5.py",
        "if schema and content.schema != schema:",
        "if False:",
        "test_another_schema_is_refused_and_named",
    ),
    mutation(
        "waveforms-by-rows",
        "files/columns.py",
        "ndmin=2, quotechar='\"').T",
        "ndmin=2, quotechar='\"')",
        "test_waveforms_are_read_from_csv_with_or_without_header_and_from_npy",
    ),
    mutation(
        "waveforms-rounded",
        "files/waveforms.py",
        'fmt="%.17g"',
        'fmt="%.12g"',
        "test_waveforms_survive_their_file_bit_for_bit",
    ),
    mutation(
        "parts-run-again",
        "files/checkpoints.py",
        "if path.is_file():\n            try:",
        "if False:\n            try:",
        "test_a_part_that_is_kept_is_not_run_again",
    ),
    mutation(
        "parts-of-another-run",
        "files/checkpoints.py",
        "if not found or found == wanted:",
        "if True:",
        "test_parts_of_another_run_are_refused",
    ),
    mutation(
        "parts-exchanged",
        "files/checkpoints.py",
        'if head.get("of") != of:',
        "if False:",
        "test_parts_that_were_exchanged_or_are_of_another_run_are_refused",
    ),
    mutation(
        "points-exchanged",
        "sweeps/store.py",
        "if own != key:",
        "if False:",
        "test_points_that_were_exchanged_give_no_numbers",
    ),
    mutation(
        "removes-what-is-not-ours",
        "files/ours.py",
        "            if others:\n",
        "            if False:\n",
        "test_a_user_s_folder_with_the_name_of_parts_is_left_alone",
    ),
    mutation(
        "replaces-what-came-meanwhile",
        "files/ours.py",
        "if path.absolute() not in _new:",
        "if True:",
        "test_an_output_that_appears_during_a_run_survives",
    ),
    mutation(
        "worker-without-a-parent",
        "sweeps/processes.py",
        "        os._exit(1)  # what is kept is whole at any moment\n",
        "",
        "test_a_worker_ends_when_its_parent_does",
    ),
    mutation(
        "stops-who-works-elsewhere",
        "sweeps/processes.py",
        "known and any(Path(one.path).is_relative_to(here) for one in found.open_files())",
        "known",
        "test_stop_in_a_copy_of_a_sweep_ends_nobody_at_the_original",
    ),
    mutation(
        "damage-unnoticed",
        "files/seal.py",
        "if found != _block(file):",
        "if False:",
        "test_no_flipped_byte_of_a_pack_or_a_part_passes",
    ),
    mutation(
        "links-followed",
        "files/tree.py",
        "if type(group.get(name, getlink=True)) is not h5py.HardLink:",
        "if False:",
        "test_an_impossible_pack_is_refused_whoever_sealed_it",
    ),
    mutation(
        "storage-elsewhere",
        "files/tree.py",
        "if made.get_external_count():",
        "if False:",
        "test_an_impossible_pack_is_refused_whoever_sealed_it",
    ),
    mutation(
        "any-size",
        "files/tree.py",
        "if declared != stored or declared > array.file.id.get_filesize():",
        "if False:",
        "test_an_impossible_pack_is_refused_whoever_sealed_it",
    ),
    mutation(
        "a-list-with-gaps",
        "files/pack_validation.py",
        "pairs_within(mapped, reach - GRAZING, per_grain, smallest, periodic, radii) <= len(keys),",
        "True,",
        "test_an_impossible_pack_is_refused_whoever_sealed_it",
    ),
    mutation(
        "another-target",
        "show/numbers.py",
        'wanted = bin_average(signals_from_dict(configuration["target"]))',
        "wanted = jnp.asarray(recall.J)",
        "test_a_recall_of_designed_waveforms_is_compared_with_their_target_too",
    ),
    mutation(
        "stages-in-any-order",
        "files/checkpoints.py",
        'for name, item in form["ordered"])',
        'for name, item in sorted(form["ordered"]))',
        "test_a_part_is_a_table_of_arrays",
    ),
    mutation(
        "any-pack-will-do",
        "files/configuration.py",
        'if pack_fingerprint(pack) != of_pack["sha256"]:',
        "if False:",
        "test_a_written_form_of_another_pack_is_refused",
    ),
    mutation(
        "material-of-the-paper",
        "files/configuration.py",
        'material_from(configuration["material"])\n',
        "Material()\n",
        "test_the_written_form_reads_back_to_the_same_experiment[m2]",
    ),
    mutation(
        "inputs-overwritten",
        "command/console.py",
        "path.exists() and Path(read).exists() and path.samefile(read)",
        "False",
        "test_not_even_by_force_is_an_input_overwritten",
    ),
    mutation(
        "outputs-overwritten",
        "command/console.py",
        "if path.exists() and not force:",
        "if False:",
        "test_nothing_is_overwritten_unasked",
    ),
    mutation(
        "identity-beside",
        "experiment/identity.py",
        'f"{folder}{os.sep}"',
        'f"{folder}"',
        "test_code_beside_the_package_is_the_users_own",
    ),
    mutation(
        "validity-amplitude",
        "experiment/validity.py",
        "abs(drive.amplitude) * own",
        "1.0 * own",
        "test_each_doubt_is_that_of_its_replica_alone",
    ),
    mutation(
        "frames-slowest",
        "simulation/frames.py",
        "float(dt[one] if dt.ndim else dt)",
        "float(dt[one] if dt.ndim and len(dt) == replicas else np.max(dt))",
        "test_eight_devices_give_the_numbers_of_one",
    ),
    mutation(
        "links-images",
        "show/scene.py",
        " + images_met(frames, frame)",
        "",
        "test_forces_through_the_faces_of_a_periodic_pack_are_along_the_nearest_images",
    ),
    mutation(
        "pascals",
        "show/stages.py",
        "float(material.modulus) / self.pascals",
        "1e7 / self.pascals",
        "test_stresses_are_in_pascals_of_the_experiments_own_material",
    ),
    mutation(
        "dry-run",
        "sweeps/cost.py",
        'SweepRunner(spec, Path(nowhere) / "sweep",',
        "SweepRunner(spec, folder,",
        "test_a_dry_run_makes_nothing_in_a_folder_that_is_there",
    ),
    mutation(
        "sweep-lock",
        "sweeps/sweep.py",
        "with store.lock(job) if store else contextlib.nullcontext():",
        "with contextlib.nullcontext():",
        "test_parts_that_a_worker_left_do_not_stop_a_sweep_of_the_library",
    ),
    mutation(
        "parts-other-batch",
        "sweeps/work.py",
        "restart=bool(Checkpoints.other_run(folder, key))",
        "restart=False",
        "test_parts_that_a_worker_left_do_not_stop_a_sweep_of_the_library",
    ),
    mutation(
        "prefix-of-another",
        "experiment/run.py",
        "pack.position, pack.quaternion, experiment.phases[0]",
        "pack.position, experiment.phases[0]",
        "test_a_prefix_serves_several_simulations",
    ),
    mutation(
        "material-of-the-pack",
        "experiment/pack_warnings.py",
        '_ELASTIC = ("poisson", "normal_damping", "wall_rigidity")',
        '_ELASTIC = ("poisson", "normal_damping")',
        "test_another_material_than_the_packs_own_warns",
    ),
    mutation(
        "ringing-weightless",
        "preparation/preparation.py",
        "pairs, material, recipe.gravity or None)",
        "pairs, material, None)",
        "test_a_pack_that_was_prepared_under_gravity_is_at_rest_under_it",
    ),
    mutation(
        "broken-runs-read",
        "reading/net.py",
        "jnp.where(jnp.all(read >= 0), right, jnp.nan)",
        "right",
        "test_nothing_is_read_from_a_broken_run",
    ),
    mutation(
        "warn-caller",
        "errors.py",
        "frame.f_back, level + 1",
        "frame.f_back, level",
        "test_another_delta0_than_the_packs_own_warns",
    ),
)


class TableError(Exception):
    """An entry of the table that does not fit the code or the tests."""


def source_of(root: Path, entry: Mutation) -> Path:
    """The file of a mutation, wherever it lies in the package."""
    ending = Path(entry.file).parts
    found = [path for path in (root / "gmem_jax").rglob(ending[-1]) if path.parts[-len(ending) :] == ending]
    if len(found) != 1:
        raise TableError(f"{entry.name}: {len(found)} files are called {entry.file}")
    count = found[0].read_text().count(entry.text)
    if count != 1:
        raise TableError(f"{entry.name}: its text stands {count} times in {found[0].relative_to(root)}")
    return found[0]


def nodes_of(root: Path, entry: Mutation) -> list[str]:
    """What pytest calls the tests of a mutation."""
    nodes = []
    for test in entry.tests:
        function = re.compile(rf"^def {test.partition('[')[0]}\(", re.MULTILINE)
        files = [path for path in sorted((root / "tests").rglob("test_*.py")) if function.search(path.read_text())]
        if len(files) != 1:
            raise TableError(f"{entry.name}: {len(files)} files have the test {test}")
        nodes.append(f"{files[0].relative_to(root)}::{test}")
    return nodes


def faults() -> list[str]:
    """What the table says that is not so, in all its entries."""
    found = [f"{name}: two mutations" for name, count in Counter(e.name for e in MUTATIONS).items() if count > 1]
    for entry in MUTATIONS:
        for look in (source_of, nodes_of):
            try:
                look(ROOT, entry)
            except TableError as error:
                found.append(str(error))
    return found


def pytest(root: Path, nodes: list[str]) -> tuple[int, str]:
    """Run tests there until one fails; pytest's exit code (1 as well if they hang) and what it said.

    XLA's programs are kept beside the repository: most mutations concern few of those that their tests need.
    """
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-p", "no:xdist", "-x", "--tb=line", *nodes]
    settings = {
        "PYTHONPATH": str(root),
        "PYTHONDONTWRITEBYTECODE": "1",
        "JAX_COMPILATION_CACHE_DIR": str(root.parent / "programs"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.3",
    }
    try:
        done = subprocess.run(
            command, cwd=root, env=os.environ | settings, capture_output=True, text=True, timeout=PATIENCE, check=False
        )
    except subprocess.TimeoutExpired:
        return 1, f"no end after {PATIENCE:g} s"
    return done.returncode, done.stdout + done.stderr


def build(root: Path, objects: Path) -> None:
    """Build the library there, by way of `compile_once`."""
    compiler = os.environ.get("CXX") or next(name for name in ("c++", "g++", "clang++") if shutil.which(name))
    settings = {
        "CXX": shlex.join([sys.executable, str(HERE), "--compile"]),
        "GMEM_MUTATIONS_CXX": compiler,
        "GMEM_MUTATIONS_OBJECTS": str(objects),
        "PYTHONPATH": str(root),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    command = [sys.executable, "-m", "gmem_jax.native.build"]
    done = subprocess.run(command, cwd=root, env=os.environ | settings, capture_output=True, text=True, check=False)
    if done.returncode:
        raise TableError(f"the library cannot be built: {done.stderr.strip()}")


def compile_once(arguments: list[str]) -> int:
    """A C++ compiler that optimises little, knows one instruction set, and copies an object that it has made before."""
    compiler = shlex.split(os.environ["GMEM_MUTATIONS_CXX"])
    arguments = ["-Og" if argument.startswith("-O") else argument for argument in arguments]
    if "-c" not in arguments:
        others = [Path(argument).stem for argument in arguments if re.fullmatch(r".*/(baseline|avx)\w*\.o", argument)]
        names = {name: re.sub("^[a-z0-9]+", ONE_SET, name) for name in others}
        same = [f"-Wl,--defsym={_kernel(name)}={_kernel(one)}" for name, one in names.items() if name != one]
        return subprocess.run([*compiler, *arguments, *same], check=False).returncode
    place = arguments.index("-o")
    target, rest = arguments[place + 1], arguments[:place] + arguments[place + 2 :]
    if re.search(rf"-DGMEM_ISA=(?!{ONE_SET})", " ".join(arguments)):
        return subprocess.run([*compiler, "-x", "c++", "-c", os.devnull, "-o", target], check=False).returncode
    preprocess = [argument for argument in rest if argument != "-c"]
    text = subprocess.run([*compiler, *preprocess, "-E", "-P"], capture_output=True, check=True).stdout
    flags = " ".join(argument for argument in rest if argument.startswith("-"))
    known = Path(os.environ["GMEM_MUTATIONS_OBJECTS"]) / hashlib.sha256(flags.encode() + text).hexdigest()
    if not known.is_file():
        code = subprocess.run([*compiler, *rest, "-o", target], check=False).returncode
        if code:
            return code
        shutil.copyfile(target, known)
    shutil.copyfile(known, target)
    return 0


def _kernel(name: str) -> str:
    """The symbol of gmem::name::kernel."""
    return f"_ZN4gmem{len(name)}{name}6kernelE"


def attempt(root: Path, objects: Path, entry: Mutation, nodes: list[str]) -> str:
    """What became of a mutation: "killed" or "SURVIVED"; the code is put right again."""
    source = source_of(root, entry)
    original = source.read_text()
    library = next((root / "gmem_jax" / "native").rglob("*.so"))
    sound = library.read_bytes()
    source.write_text(original.replace(entry.text, entry.wrong))
    try:
        if source.suffix in COMPILED:
            build(root, objects)
        code, said = pytest(root, nodes)
    finally:
        source.write_text(original)
        library.write_bytes(sound)
    if code not in (0, 1):
        raise TableError(f"{entry.name}: pytest ended with {code}\n{said}")
    return "killed" if code else "SURVIVED"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="mutations to try, with * and ?; default all")
    parser.add_argument("--list", action="store_true", help="only check the table against code and tests, and show it")
    parser.add_argument("--trust", action="store_true", help="do not run the tests on the code as it is first")
    options = parser.parse_args()
    chosen = [
        entry
        for entry in MUTATIONS
        if not options.names or any(fnmatch.fnmatch(entry.name, name) for name in options.names)
    ]
    if not chosen:
        parser.error(f"no mutation is called {' or '.join(options.names)}")
    try:
        for entry in chosen:
            source, nodes = source_of(ROOT, entry), nodes_of(ROOT, entry)
            if options.list:
                print(f"{entry.name:36} {source.relative_to(ROOT)}: {', '.join(nodes)}")
        return 0 if options.list else run(chosen, options.trust)
    except TableError as error:
        print(error, file=sys.stderr)
        return 2


def run(chosen: list[Mutation], trust: bool) -> int:
    """Try the mutations in a copy of the repository; 1 if any survived, or if the tests fail without them."""
    survived = []
    with tempfile.TemporaryDirectory(prefix="mutations-") as folder:
        root, objects = Path(folder) / "repository", Path(folder) / "objects"
        objects.mkdir()
        shutil.copytree(ROOT, root, ignore=shutil.ignore_patterns(*LEFT_OUT))
        build(root, objects)
        nodes = {entry.name: nodes_of(root, entry) for entry in chosen}
        if not trust:
            code, said = pytest(root, list(dict.fromkeys(node for some in nodes.values() for node in some)))
            if code:
                print(f"the tests fail without any mutation\n{said}", file=sys.stderr)
                return 1
        for entry in chosen:
            began = time.perf_counter()
            outcome = attempt(root, objects, entry, nodes[entry.name])
            print(f"{outcome:9} {entry.name:36} {time.perf_counter() - began:5.0f} s", flush=True)
            survived += [entry.name] if outcome == "SURVIVED" else []
    print(f"{len(chosen)} mutations, {len(survived)} survived{': ' if survived else ''}{', '.join(survived)}")
    return 1 if survived else 0


if __name__ == "__main__":
    sys.exit(compile_once(sys.argv[2:]) if sys.argv[1:2] == ["--compile"] else main())
