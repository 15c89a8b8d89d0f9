"""gmem_jax: differentiable, batched simulation of waveform memory in granular packs.

Units are R = E = rho = 1 (time in t_c = R sqrt(rho/E)); `Material` converts. Ask for 64-bit numbers first:
``jax.config.update("jax_enable_x64", True)``.

    pack = gm.load_pack("tetra-325-a")
    experiment = gm.Experiment(pack, gm.six_signals(), friction=gm.Hooke(mu=1.0))
    recall = gm.run(experiment)  # on the host; `gm.recall` and `gm.fidelity` are for jit, vmap and grad
"""

import importlib
from typing import TYPE_CHECKING, Any

import gmem_start  # first: where this is `python -m gmem_jax`, it answers Ctrl-C from now on

# In a process of the command a module loads what it needs, and `gmem --help` nothing.
if TYPE_CHECKING or not gmem_start.alone:
    from gmem_jax.derivatives.gradient import value_and_grad
    from gmem_jax.derivatives.jacobian import exact as jacobian
    from gmem_jax.design.kernel import KernelMatrix, MemoryKernel, kernel_matrix, memory_kernel
    from gmem_jax.errors import FileFormatError, NotAtRestError, RunFailedError
    from gmem_jax.experiment.analysis import running_mean
    from gmem_jax.experiment.changes import replace
    from gmem_jax.experiment.experiment import Experiment
    from gmem_jax.experiment.pack import Pack, pack_from, stack
    from gmem_jax.experiment.recall import Recall, fidelity, gain, recall
    from gmem_jax.experiment.record import describe, to_dict
    from gmem_jax.experiment.run import prefix_of, run
    from gmem_jax.experiment.samples import waveform_from
    from gmem_jax.experiment.signals import Bumps, Signals, SignalSets, Spline, signals, six_signals, waveform, words
    from gmem_jax.experiment.stages import compress, cycle, hold, read, rest, shake, train, write
    from gmem_jax.experiment.stepping import at_accuracy, stable_step
    from gmem_jax.files.cache import list_packs
    from gmem_jax.files.configuration import from_dict
    from gmem_jax.files.datasets import to_csv, to_xarray
    from gmem_jax.files.packs import load_pack, save_pack
    from gmem_jax.files.protocols import load_protocol, save_protocol
    from gmem_jax.files.recalls import load_recall, save_recall
    from gmem_jax.files.waveforms import load_waveforms, save_waveforms
    from gmem_jax.physics.contact.frictionless import Frictionless
    from gmem_jax.physics.contact.hooke import Hooke
    from gmem_jax.physics.contact.mindlin import Mindlin
    from gmem_jax.physics.contact.mindlin_rescaled import MindlinRescaled
    from gmem_jax.physics.grain import Clump, clump, sized, sphere, tetra
    from gmem_jax.physics.material import Material
    from gmem_jax.physics.state import Status, explain
    from gmem_jax.preparation.grading import lognormal, mixture
    from gmem_jax.preparation.preparation import prepare
    from gmem_jax.preparation.recipe import Recipe
    from gmem_jax.simulation.protocol import Protocol
    from gmem_jax.simulation.stage import Drive, Stage

if TYPE_CHECKING:
    from gmem_jax.design.by_kernel import design_by_kernel
    from gmem_jax.design.drive import TunedDrive, design_drive
    from gmem_jax.design.waveforms import Design, design_waveforms
    from gmem_jax.experiment import protocols
    from gmem_jax.reading import capacity, classify
    from gmem_jax.show.recalls import plot
    from gmem_jax.show.view import view
    from gmem_jax.simulation import observables
    from gmem_jax.simulation.progress import ProgressBar
    from gmem_jax.sweeps.sweep import sweep

_LATER = {  # what loads flax or optax, or is seldom asked for, or stands above what does, by where it is
    "Design": "gmem_jax.design.waveforms",
    "design_by_kernel": "gmem_jax.design.by_kernel",
    "design_waveforms": "gmem_jax.design.waveforms",
    "TunedDrive": "gmem_jax.design.drive",
    "design_drive": "gmem_jax.design.drive",
    "capacity": "gmem_jax.reading.capacity",
    "classify": "gmem_jax.reading.classify",
    "protocols": "gmem_jax.experiment.protocols",
    "observables": "gmem_jax.simulation.observables",
    "ProgressBar": "gmem_jax.simulation.progress",
    "sweep": "gmem_jax.sweeps.sweep",
    "plot": "gmem_jax.show.recalls",
    "view": "gmem_jax.show.view",
}
_MODULES = ("capacity", "classify", "observables", "protocols")


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module 'gmem_jax' has no attribute {name!r}")
    module = importlib.import_module(_LATER[name])
    return module if name in _MODULES else getattr(module, name)


def __dir__() -> list[str]:
    return [*__all__, *(name for name in globals() if name.startswith("__"))]


__all__ = [
    "Bumps",
    "Clump",
    "Design",
    "Drive",
    "Experiment",
    "FileFormatError",
    "Frictionless",
    "Hooke",
    "KernelMatrix",
    "Material",
    "MemoryKernel",
    "Mindlin",
    "MindlinRescaled",
    "NotAtRestError",
    "Pack",
    "ProgressBar",
    "Protocol",
    "Recall",
    "Recipe",
    "RunFailedError",
    "SignalSets",
    "Signals",
    "Spline",
    "Stage",
    "Status",
    "TunedDrive",
    "at_accuracy",
    "capacity",
    "classify",
    "clump",
    "compress",
    "cycle",
    "describe",
    "design_by_kernel",
    "design_drive",
    "design_waveforms",
    "explain",
    "fidelity",
    "from_dict",
    "gain",
    "hold",
    "jacobian",
    "kernel_matrix",
    "list_packs",
    "load_pack",
    "load_protocol",
    "load_recall",
    "load_waveforms",
    "lognormal",
    "memory_kernel",
    "mixture",
    "observables",
    "pack_from",
    "plot",
    "prefix_of",
    "prepare",
    "protocols",
    "read",
    "recall",
    "replace",
    "rest",
    "run",
    "running_mean",
    "save_pack",
    "save_protocol",
    "save_recall",
    "save_waveforms",
    "shake",
    "signals",
    "six_signals",
    "sized",
    "sphere",
    "stable_step",
    "stack",
    "sweep",
    "tetra",
    "to_csv",
    "to_dict",
    "to_xarray",
    "train",
    "value_and_grad",
    "view",
    "waveform",
    "waveform_from",
    "words",
    "write",
]
