"""What `test_devices` runs in processes of its own: experiments whose replicas lie on several devices.

XLA_FLAGS=--xla_force_host_platform_device_count=8 python tests/simulation/several_devices.py alone native out.npz
python tests/simulation/several_devices.py ADDRESS native out.npz 2 0    # the first of two processes
"""

import sys
from pathlib import Path

import jax
import numpy as np

import gmem_jax as gm
from gmem_jax.experiment.several import run_several

PACK = Path(__file__).parents[1] / "data" / "tetra-27.h5"
SHORT = {"t0": 75.0, "rest": 0.02, "hold": 0.02, "store": 0.02}  # one step a bin


def main(address: str, backend: str, target: str, processes: str = "1", number: str = "0") -> None:
    """Run some experiments on all devices there are; the first process writes their recalls."""
    jax.config.update("jax_enable_x64", True)
    if address != "alone":
        jax.distributed.initialize(address, int(processes), int(number))
    from scenes import with_skin  # which computes

    pack = with_skin(gm.load_pack(PACK), 0.05)  # lists are made anew on the way
    base = gm.Experiment(pack, gm.six_signals(), backend=backend, **SHORT)
    points = [gm.replace(base, {"friction.mu": mu, "gamma0": gamma0}) for mu, gamma0 in ((1.0, 1e-3), (0.4, 2e-3))]
    # One number for each of nine replicas, more than devices: of all grains, of the walls, of time.
    each = np.arange(9.0)
    own = {"gravity": 1e-5 * each, "wall_mu": 0.1 * each, "t0": 75.0 - 5.0 * each, "creep": 1e-6 * each}
    own |= {"gamma0": 1e-4 * (1.0 + each), "shear_share": 0.5 + 0.01 * each}
    seen = {
        "creep": lambda simulation, state: simulation.creep * np.ones(state.replicas),
        "gamma0": lambda simulation, state: simulation.path.gamma0 * np.ones(state.replicas),
        "share": lambda simulation, state: simulation.path.share * np.ones(state.replicas),
    }
    filmed = gm.run(gm.replace(base, {**own, "signals": gm.words(3), "observe": seen}), frames=3, frames_of=5)
    # A mark that is set when waveforms have made the walls differ.
    marked = gm.Protocol(gm.cycle(), gm.write(), gm.Stage("wait", length=0.02, role="hold", mark=True), gm.read())
    protocol = {"t0": 75.0, "protocol": marked, "observe": [gm.observables.nonaffine()]}
    compared = gm.run(gm.Experiment(pack, gm.six_signals(), backend=backend, **protocol))
    recalls = [gm.run(base, batch=3), *run_several(points), filmed, compared]
    if number == "0":
        named = {f"p_sig-{place}": recall.p_sig for place, recall in enumerate(recalls)}
        status = [np.asarray(recall.status) for recall in recalls]
        *_, last = filmed.stages.values()
        for name, values in (("creep", own["creep"]), ("gamma0", own["gamma0"]), ("share", own["shear_share"])):
            np.testing.assert_allclose(last.observed[name][-1], values)
        *_, after = compared.stages.values()
        named["nonaffine"] = after.observed["nonaffine"]
        named["time"] = getattr(filmed.frames, "time", np.zeros(0))
        np.savez(target, devices=jax.device_count(), status=np.concatenate(status), **named)


if __name__ == "__main__":
    main(*sys.argv[1:])
