"""The contents of every kind of file, with units: the table by which files are written, read and documented."""

from collections.abc import Container, Mapping
from typing import Any, NamedTuple

from gmem_jax.files.validation import Array
from gmem_jax.simulation.sample import MEASURED

DIMENSIONS = {  # names of dimensions, and the descriptions of their scales where no array of a file is the scale
    "u": "bin of the compression variable",
    "axis": "x, y, z",
    "component": "w, x, y, z of a quaternion",
    "side": "the two spheres of a candidate contact",
    "grain": "number of the grain",
    "plane": "lower planes of x, y, z, then the upper ones",
    "sphere": "number of the sphere: grain K + place in the grain",
    "part": "place of the sphere in its grain",
    "candidate": "number of the candidate contact",
    "signal": "number of the signal",
    "replica": "0 is the zero signal, k the k-th signal",
    "common": "the one run that all replicas have in common",
    "time": "end of the bin",
    "frame": "number of the configuration",
    "boundary": "number of the configuration, and one more",
    "contact": "number of the contact, of all configurations",
    "bump": "number of the basis waveform",
    "read": "number of the stage that reads, of those in the attribute `reads`",
    "channel": "number of the channel that is read, of those in the attribute `channels`",
    "written": "number of the channel that was written on",
}


class Schema(NamedTuple):
    """A kind of file.

    Attributes:
        name: name with version, as in the attribute `schema` of a file.
        title: name for a person.
        words: what the file holds, and which commands make it.
        arrays: every array by its path, or every field of JSON.
        texts: descriptions of the attributes by name.
        unequal: further arrays by path, of packs whose spheres are not all of radius 1.
    """

    name: str
    title: str
    words: str
    arrays: Mapping[str, Array]
    texts: Mapping[str, str] = {}
    unequal: Mapping[str, Array] = {}

    def declared(self, found: Container[str]) -> dict[str, Array]:
        """Its arrays, and those of `unequal` whose paths are in `found`."""
        return {**self.arrays, **{path: array for path, array in self.unequal.items() if path in found}}


_CONFIGURATION = {
    "configuration": "JSON: `experiment`, all its parameters; beside it what defaults came to, versions, commit, device"
}

STAGE = {  # arrays of a recall or a preparation in stages/NAME; their last dimension may be `common`: see docs/files.md
    "time": Array(
        "real",
        ("time",),
        "t0",
        "end of the bin, since the run began (in a pack: its first stage)",
    ),
    **{name: Array("real", ("time", *each.dimensions), *each[:2]) for name, each in MEASURED.items()},
}

UNEQUAL = {  # arrays of packs whose spheres are not all of radius 1; else they are missing
    "radii": Array("real", ("part",), "R", "radii of the spheres of a grain"),
    "sizes": Array("real", ("grain",), "1", "sizes of the grains: factors on their lengths"),
}

RUBBED = {  # array of frames between walls with friction; else it is missing
    "wall_friction": Array(
        "real",
        ("frame", "sphere", "plane", "axis"),
        "E R^2",
        "tangential forces of the lower planes of x, y and z on the spheres, then of the upper ones",
    ),
}

FRAMES = {  # configurations along the run that made a recall or a pack, in frames
    "time": Array("real", ("frame",), "t_c", "time since the beginning of the run"),
    "u": Array("real", ("frame",), "1", "compression variable"),
    "position": Array("real", ("frame", "grain", "axis"), "R", "centres of the grains"),
    "quaternion": Array("real", ("frame", "grain", "component"), "1", "orientations of the grains"),
    "lower": Array("real", ("frame", "axis"), "R", "lower planes of the box"),
    "upper": Array("real", ("frame", "axis"), "R", "upper planes of the box"),
    "start": Array("whole", ("boundary",), "1", "contacts of frame f are rows start[f] to start[f + 1]"),
    "spheres": Array("whole", ("contact", "side"), "1", "spheres i < j that touch; sphere k of grain n is n K + k"),
    "normal_force": Array("real", ("contact",), "E R^2", "repulsive normal force"),
    "friction_force": Array("real", ("contact", "axis"), "E R^2", "tangential force on i, the opposite of that on j"),
    "offsets": Array("real", ("part", "axis"), "R", "centres of the spheres of a grain, in its own frame"),
}

PACK = Schema(
    "gmem-pack/0.1",
    "Pack (.h5)",
    "Grains at rest in their box: `gmem prepare`, `gm.save_pack`.",
    {
        "position": Array("real", ("grain", "axis"), "R", "centres of the grains"),
        "quaternion": Array("real", ("grain", "component"), "1", "orientations of the grains"),
        "lower": Array("real", ("axis",), "R", "lower planes of the box"),
        "upper": Array("real", ("axis",), "R", "upper planes of the box"),
        "delta0": Array("real", (), "1", "areal compression that the pack was cycled with"),
        "ringing_period": Array("real", (), "t_c", "T1, period of the slowest shear mode of the box"),
        "clump/offsets": Array("real", ("part", "axis"), "R", "centres of the spheres of a grain, in its own frame"),
        "clump/mass": Array("real", (), "rho R^3", "mass of a grain"),
        "clump/inertia": Array("real", ("axis",), "rho R^5", "principal moments of inertia of a grain"),
        "clump/diameter": Array("real", (), "R", "diameter of the sphere about its centre that encloses a grain"),
        "pairs/candidates": Array("whole", ("side", "candidate"), "1", "numbers of the spheres that may touch"),
        "pairs/reference": Array(
            "real", ("sphere", "axis"), "1", "spheres when the list was made, in parts of the box"
        ),
        "pairs/smallest": Array("real", ("axis",), "R", "edges of the box at u = 1, for which the list was made"),
        "pairs/reach": Array("real", (), "R", "distance up to which spheres are listed"),
    },
    {
        "name": "name of the pack",
        "record": "JSON: the recipe with its seed, what was measured at rest, versions, commit, device",
        "boundary": 'boundary of a periodic box: "periodic", or like "periodic,periodic,walls"; missing with six walls',
        "clump: shape": 'like "tetra(0.6)"',
        "clump: isotropic": "whether its three moments are equal",
    },
    {f"clump/{name}": array for name, array in UNEQUAL.items()},
)

RECALL = Schema(
    "gmem-recall/0.1",
    "Recall (.h5)",
    "The recall of S signals: `gmem recall`, `gmem demo`, the points of a sweep, `gm.save_recall`.",
    {
        "u": Array("real", ("u",), "1", "centres of the bins of u, or of the time of a read in which u stands still"),
        "signal": Array("text", ("signal",), "1", "names of the signals; words by their bits"),
        "shear": Array("real", ("signal", "u"), "1", "I(u), the waveforms as applied, in parts of gamma0"),
        "J": Array("real", ("signal", "u"), "1", "J(u), their integrals averaged over each bin"),
        "p_sig": Array("real", ("signal", "u"), "E", "recalled signals, the background subtracted"),
        "rounding": Array("real", ("signal",), "E", "round-off in p_sig, root mean square"),
        "gain": Array("real", (), "1", "G of the set"),
        "fidelity": Array("real", (), "1", "F of the set"),
        "windowed_gain": Array("real", (), "1", "G after a running mean over the ringing period"),
        "windowed_fidelity": Array("real", (), "1", "F after a running mean over the ringing period"),
        "window": Array("real", (), "t_c", "T1, the ringing period"),
        "signal_gain": Array("real", ("signal",), "1", "G of each signal by itself; NaN of silence"),
        "signal_fidelity": Array("real", ("signal",), "1", "F of each signal by itself, with that gain"),
        "signal_windowed_fidelity": Array("real", ("signal",), "1", "F of each signal after a running mean over T1"),
        "signal_correlation": Array("real", ("signal",), "1", "correlation of each p_sig with its J"),
        "residual_speed": Array("real", ("replica",), "1", "largest grain speed before the readout, over the walls'"),
        "status": Array("whole", ("replica",), "1", "bits of gm.Status; 0 is sound"),
        "dt": Array("real", (), "t_c", "time step; [replica] where t0 differs between replicas"),
    },
    _CONFIGURATION,
)

KERNEL = Schema(
    "gmem-kernel/0.1",
    "Memory kernel (.h5)",
    "The linear part of a pack's memory, measured on n bumps: `gmem kernel`.",
    {
        "u": Array("real", ("u",), "1", "compression variable of the recall, centres of the bins"),
        "centres": Array("real", ("bump",), "1", "v, centres of the bumps of shear"),
        "width": Array("real", (), "1", "width of the bumps, in u"),
        "kernel": Array("real", ("u", "bump"), "E", "M(u, v), recall over the integral of the bump"),
        "odd": Array("real", ("bump", "u"), "E", "half the difference of the recalls of a bump and its opposite"),
        "even": Array("real", ("bump", "u"), "E", "half the sum of these recalls; 0 for a linear memory"),
        "gamma0": Array("real", (), "1", "shear amplitude of the measurement"),
        "delta0": Array("real", (), "1", "areal compression"),
    },
    _CONFIGURATION,
)


def declared_of_recall(reads: int, channels: int, *, own_steps: bool = False) -> dict[str, Array]:
    """The arrays of a recall of several reads and channels: an axis for each where there is more than one.

    Args:
        reads: number of reads.
        channels: number of channels.
        own_steps: whether replicas have time steps of their own.
    """
    lead = ("read",) * (reads > 1) + ("channel",) * (channels > 1)
    found = dict(RECALL.arrays)
    for name, array in found.items():
        if name.startswith("signal_") or name in ("shear", "J", "p_sig", "fidelity", "windowed_fidelity"):
            found[name] = array._replace(shape=(*lead, *array.shape))
        elif name in ("gain", "windowed_gain"):
            found[name] = array._replace(shape=lead + ("written",) * (channels > 1))
    if own_steps:
        found["dt"] = found["dt"]._replace(shape=("replica",))
    return found


_RUN = {
    "seconds": Array("real", (), "s", "wall time of the call that finished the run"),
    "status": Array("whole", (), "1", "0: no run failed; warnings stand in the recall itself"),
}
_MADE = {**_RUN, "configuration": Array("object", (), "", _CONFIGURATION["configuration"])}

GRADIENT = Schema(
    "gmem-gradient/0.1",
    "Gradient (.json)",
    "Exact derivatives of the fidelity: `gmem gradient`.",
    {
        "pack": Array("text", (), "", "file or name of the pack"),
        "fidelity": Array("real", (), "1", "F"),
        "places": Array("rows", ("signal", "place"), "1", "u where each waveform can be changed"),
        "gradient/waveform": Array("rows", ("signal", "place"), "1", "dF by the height of the waveform there"),
        "gradient/gamma0": Array("real", (), "1", "dF/dgamma0"),
        "gradient/mu": Array("real, if any", (), "1", "dF/dmu; where the law has one"),
        "gradient/stiffness": Array("real, if any", (), "1/(E R)", "dF/dk_H (or k_M, 1/(E R^0.5)); where there is one"),
        **_MADE,
    },
)

TUNED = Schema(
    "gmem-tuned/0.1",
    "Tuned drive (.json)",
    "The drive with the best mean fidelity of some packs: `gmem tune`.",
    {
        "packs": Array("list", ("pack",), "", "files or names of the packs"),
        "before": Array("real", (), "1", "mean F of the initial drive"),
        "fidelity": Array("real", (), "1", "mean F of the best drive"),
        "each": Array("real", ("pack",), "1", "F of every pack with the best drive"),
        "values": Array("object", (), "", "gamma0 (1), mu (1) and stiffness (E R) of the best drive"),
        "history": Array("list", ("iteration",), "", "values and their mean F after every iteration"),
        **_MADE,
    },
)

READING = Schema(
    "gmem-reading/0.1",
    "Classification (.json)",
    "How well the words of a recall are read: `gmem classify`.",
    {
        "recall": Array("text", (), "", "file of the recall"),
        "pack": Array("text", (), "", "pack of the recall"),
        "bits": Array("whole", (), "1", "length L of the words"),
        "words": Array("whole", (), "1", "number of words, 2^L"),
        "background": Array("text", (), "", "how the background was subtracted"),
        "readers": Array(
            "object",
            (),
            "",
            "by reader: accuracy and its SD over nets, error rate of each bit, information in bits, the word read "
            "for each word stored (of every net, for nets)",
        ),
        "nets": Array(
            "list", ("net",), "", "seed, accuracy, cross-entropy (nats), validation accuracy, steps, seconds"
        ),
        **_RUN,
        "status": Array("whole", (), "1", "bits of gm.Status of the recall; 0 is sound"),
    },
)

DESIGN = Schema(
    "",
    "Waveforms (.csv)",
    "A column for each signal, row k of n at u = k / (n + 1), 0 at both ends: for `gmem recall --signals`. `gmem "
    "design` writes comments above: `# target:` the waveforms whose integrals J the recalls shall follow, `# design:` "
    "the course of the design.",
    {
        "signal_1, ...": Array("real", ("sample",), "1", "I(u) in parts of gamma0"),
        "# target": Array("object", (), "", "JSON: the wanted waveforms, as in a configuration"),
        "# design": Array("object", (), "", "JSON: pack, F before and after, gain, F after every iteration"),
    },
)

NET = Schema(
    "gmem-classifier/0.1",
    "Net (.msgpack)",
    "The reader of words of one length and seed, finished or not: `gmem classify --nets`. 512 bytes of checksum, then "
    "MessagePack as flax writes it.",
    {
        "recipe": Array("text", (), "", "JSON: gm.classify.TrainingConfig, its layers and training data"),
        "training": Array("object", (), "", "seed, steps, loss (nats), validation accuracy, seconds"),
        "parameters/Dense_k/kernel": Array("real", ("inputs", "outputs"), "1", "weights of layer k, float32"),
        "parameters/Dense_k/bias": Array("real", ("outputs",), "1", "biases of layer k, float32"),
    },
)

SWEEP = Schema(
    "gmem-sweep/0.1",
    "Sweep (a folder)",
    "`gmem sweep`: points/KEY.h5 are recalls, packs/KEY.h5 packs; `gmem sweep export` makes one table of them. "
    "sweep.json holds:",
    {
        "names": Array("list", ("name",), "", "names of the values that vary"),
        "shared": Array("object", (), "", "the values that all points have"),
        "points": Array("list", ("point",), "", "values and key of each point, which has a file once computed"),
    },
)

SCHEMAS = (RECALL, PACK, KERNEL, GRADIENT, TUNED, READING, DESIGN, NET, SWEEP)


def other_kind(found: Any, *wanted: str) -> str:
    """The reason to refuse a file of schema `found` where one of the schemas `wanted` is needed, all by name."""
    kinds = {schema.name: schema.title.partition(" (")[0].lower() for schema in SCHEMAS}
    needed = " or ".join(f"a {kinds[name]}" for name in wanted)
    if found in kinds:
        return f"this is a {kinds[found]}; {needed} is needed"
    here = ", ".join(wanted)
    if found is None:
        return f"it has no schema; {needed} is needed ({here})"
    if str(found).partition("/")[0] in (name.partition("/")[0] for name in wanted):
        return f"its schema is {str(found)[:40]!r}, of another version; this one reads {here}"
    return f"its schema is {str(found)[:40]!r}, which is unknown here; {needed} is needed ({here})"
