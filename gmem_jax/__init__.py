"""gmem_jax: differentiable, batched simulation of waveform memory in granular packs.

Units are R = E = rho = 1 (time in t_c = R sqrt(rho/E)); `Material` converts. Ask for 64-bit numbers first:
``jax.config.update("jax_enable_x64", True)``.
"""

from gmem_jax.derivatives.gradient import value_and_grad
from gmem_jax.design.kernel import MemoryKernel, memory_kernel
from gmem_jax.design.waveforms import Design, Drive, design_drive, design_waveforms
from gmem_jax.experiment.analysis import running_mean
from gmem_jax.experiment.experiment import Experiment, Timing
from gmem_jax.experiment.host import RunFailedError
from gmem_jax.experiment.pack import Pack, pack_from, stack
from gmem_jax.experiment.recall import Recall, fidelity, gain, run_memory
from gmem_jax.experiment.signals import Bumps, Samples, Signals, six_signals, waveform, words
from gmem_jax.files.storage import (
    FileFormatError,
    list_packs,
    load_pack,
    load_recall,
    load_waveforms,
    save_pack,
    save_recall,
    save_waveforms,
)
from gmem_jax.physics.contact.frictionless import Frictionless
from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.contact.mindlin import Mindlin
from gmem_jax.physics.contact.mindlin_rescaled import MindlinRescaled
from gmem_jax.physics.grain import Clump, clump, sphere, tetra
from gmem_jax.physics.material import Material
from gmem_jax.physics.state import Status, explain
from gmem_jax.preparation.preparation import Recipe, prepare
from gmem_jax.reading import net as classify

__all__ = [
    "Bumps",
    "Clump",
    "Design",
    "Drive",
    "Experiment",
    "FileFormatError",
    "Frictionless",
    "Hooke",
    "Material",
    "MemoryKernel",
    "Mindlin",
    "MindlinRescaled",
    "Pack",
    "Recall",
    "Recipe",
    "RunFailedError",
    "Samples",
    "Signals",
    "Status",
    "Timing",
    "classify",
    "clump",
    "design_drive",
    "design_waveforms",
    "explain",
    "fidelity",
    "gain",
    "list_packs",
    "load_pack",
    "load_recall",
    "load_waveforms",
    "memory_kernel",
    "pack_from",
    "prepare",
    "run_memory",
    "running_mean",
    "save_pack",
    "save_recall",
    "save_waveforms",
    "six_signals",
    "sphere",
    "stack",
    "tetra",
    "value_and_grad",
    "waveform",
    "words",
]
