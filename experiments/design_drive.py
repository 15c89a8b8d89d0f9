"""Drive parameters that maximise the fidelity: gamma0, mu and k_H on shipped packs, delta0 on packs prepared anew.

python experiments/design_drive.py [-o drive] [--packs tetra-325-a,tetra-325-b,tetra-325-c]
                                   [--check tetra-325-d,tetra-325-e] [--delta0 0.025,0.05,0.1] [--seeds 1,2]

The drive is found on some packs and checked on others. Half an hour on two cores.
"""

import argparse
import json
from typing import Any

import jax
import numpy as np
from console import in_one_line, new_folder, say

import gmem_jax as gm
from gmem_jax.show.figures import history_figure
from gmem_jax.show.render_matplotlib import to_matplotlib

BOUNDS = {"gamma0": (3e-4, 3e-3), "friction.mu": (0.5, 2.0), "friction.stiffness": (0.07, 0.29)}


def mean_and_error(values: list[float]) -> str:
    """Mean and its standard error."""
    error = np.std(values, ddof=1) / np.sqrt(len(values)) if len(values) > 1 else float("nan")
    return f"{np.mean(values):.4f} +- {error:.4f}"


def main() -> None:
    """Design, check on other packs, then vary delta0."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=new_folder, default="drive", help="folder to write to")
    parser.add_argument("--packs", default="tetra-325-a,tetra-325-b,tetra-325-c", help="packs to design on")
    parser.add_argument("--check", default="tetra-325-d,tetra-325-e", help="packs to check on")
    parser.add_argument("--delta0", default="0.025,0.05,0.1", help="compressions to prepare packs for; empty for none")
    parser.add_argument("--seeds", default="1,2", help="seeds of those packs")
    parser.add_argument("--iterations", type=int, default=5)
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_enable_x64", True)

    def fidelity(experiment: gm.Experiment) -> float:
        return float(gm.run(experiment).fidelity)

    def of_packs(names: str) -> list[gm.Experiment]:
        return [gm.Experiment(gm.load_pack(name), gm.six_signals()) for name in names.split(",")]

    found = gm.design_drive(of_packs(arguments.packs), BOUNDS, iterations=arguments.iterations, progress=say)
    for values, mean in found.history:
        print("  ".join(f"{name} {value:.4g}" for name, value in values.items()), f" mean F {mean:.4f}", flush=True)
    result: dict[str, Any] = {"values": found.values, "each": found.each.tolist(), "history": found.history}
    check = of_packs(arguments.check)
    result["check_before"] = [fidelity(each) for each in check]
    result["check"] = [fidelity(gm.replace(each, found.values)) for each in check]
    print(f"designed on {arguments.packs}: F {found.before:.4f} -> {found.fidelity:.4f}; on {arguments.check}: "
          f"{mean_and_error(result['check_before'])} -> {mean_and_error(result['check'])}", flush=True)  # fmt: skip

    result["delta0"] = {}
    for text in filter(None, arguments.delta0.split(",")):
        pair: dict[str, list[float]] = {"default": [], "designed": []}
        for seed in map(int, arguments.seeds.split(",")):
            pack = gm.prepare(delta0=float(text), seed=seed, name=f"tetra-325-{seed}-delta0-{text}")
            experiment = gm.Experiment(pack, gm.six_signals())
            for key, values in (("default", {}), ("designed", found.values)):
                pair[key].append(fidelity(gm.replace(experiment, values)))
        result["delta0"][text] = pair
        print(f"delta0 {text}: " + ", ".join(f"{key} {mean_and_error(row)}" for key, row in pair.items()), flush=True)
    (arguments.output / "drive.json").write_text(json.dumps(result, indent=1))
    to_matplotlib(history_figure({"drive": [mean for _, mean in found.history]})).save(arguments.output / "history.png")


if __name__ == "__main__":
    in_one_line(main)
