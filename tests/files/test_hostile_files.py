"""Files cannot lie: what was changed is refused in one line, before it does harm. In full size: reliability/fuzz.py."""

import json
import subprocess
import sys
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from scenes import TESTS, TETRA_27

import gmem_jax as gm
from gmem_jax.files.checkpoints import load_part, save_part
from gmem_jax.files.hdf5 import writing
from gmem_jax.files.seal import BLOCK, seal

PACK = TETRA_27
FUZZ = TESTS / "reliability" / "fuzz.py"


def changed(tmp_path: Path, change: Callable[[h5py.File], None]) -> Path:
    """A pack whose content was changed, and which was sealed anew."""
    path = tmp_path / "changed.h5"
    path.write_bytes(PACK.read_bytes())
    with h5py.File(path, "r+") as file:
        change(file)
    seal(path)
    return path


def put(file: h5py.File, name: str, values: np.ndarray) -> None:
    """Another array at its place."""
    del file[name]
    file[name] = values


def test_two_hundred_hostile_inputs_end_in_one_line_or_work() -> None:
    """In a process of its own, whose children may crash; it must not have started JAX."""
    done = subprocess.run([sys.executable, str(FUZZ), "200", "--seed", "7"], capture_output=True, text=True)
    found = json.loads(done.stdout)
    assert (done.returncode, found["failures"]) == (0, [])
    assert found["refused"] > 100
    assert all(count > 0 for count in found["inputs"].values())


def test_no_flipped_byte_of_a_pack_or_a_part_passes(tmp_path: Path) -> None:
    save_part(tmp_path / "part.npz", (OrderedDict(one=np.arange(4)), np.zeros(3)))
    for source, load in ((PACK, gm.load_pack), (tmp_path / "part.npz", load_part)):
        whole, damaged = source.read_bytes(), tmp_path / f"damaged{source.suffix}"
        for place in [*range(0, len(whole), 101), *range(0, 80)]:
            content = bytearray(whole)
            content[place] ^= 0x10
            damaged.write_bytes(bytes(content))
            with pytest.raises(gm.FileFormatError, match="damaged"):
                load(damaged)


def scale(name: str, factor: float) -> Callable[[h5py.File], None]:
    """Multiplies an array."""
    return lambda file: put(file, name, file[name][()] * factor)


def squeeze(file: h5py.File) -> None:
    """A pack at 0.9 of its size that does not say so, and that nothing was measured of."""
    for name in ("position", "lower", "upper", "pairs/smallest"):
        put(file, name, file[name][()] * 0.9)
    file.attrs["record"] = "{}"


def negative(file: h5py.File) -> None:
    file["pairs/candidates"][0, 0] = -1


def one_less(file: h5py.File) -> None:
    put(file, "pairs/candidates", file["pairs/candidates"][:, 1:])


def huge(file: h5py.File) -> None:
    del file["position"]
    file.create_dataset("position", (10**12, 3), float)


def many(file: h5py.File) -> None:
    del file["pairs/candidates"]
    file.create_dataset("pairs/candidates", (2, 3 * 10**8), "i4", chunks=(2, 1 << 16))


def outside(file: h5py.File) -> None:
    del file["position"]
    file.create_dataset("position", (27, 3), float, external=[("/dev/zero", 0, 27 * 24)])


def link(file: h5py.File) -> None:
    del file["position"]
    file["position"] = h5py.ExternalLink(str(PACK), "/position")


def loop(file: h5py.File) -> None:
    file["again"] = file["/"]


def packed(file: h5py.File) -> None:
    values = file["position"][()]
    del file["position"]
    file.create_dataset("position", data=values, compression="gzip")


def not_a_number(file: h5py.File) -> None:
    file["position"][0, 0] = np.nan


CHANGES = [
    (not_a_number, "position holds numbers that are not finite"),
    (
        lambda file: put(file, "quaternion", file["quaternion"][:, :3]),
        r"'quaternion' has shape \[27, 3\], must be \[grain, 4\]",
    ),
    (lambda file: put(file, "position", file["position"][()].astype(complex)), "'position' is not an array of numbers"),
    (
        lambda file: put(file, "lower", file["lower"][()].astype("i4")),
        "'lower' holds int32, must hold float32 or float64",
    ),
    (scale("quaternion", 1.1), "a quaternion is not of length 1"),
    (scale("upper", 10.0), "grains fill"),
    (scale("clump/mass", 1.001), "the filling on record"),
    (scale("clump/diameter", 1.01), "the grain's diameter"),
    (scale("delta0", 20.0), r"delta0 must be in \[1e-9, 0.5\)"),
    (scale("ringing_period", 5e7), r"its ringing period is .* t_c, must be between 6.36 and 147 in a box of this size"),
    (scale("ringing_period", 0.1), "its ringing period is 1.96"),
    (squeeze, "its list misses spheres"),
    (negative, "a candidate names a sphere that is not among its 108"),
    (one_less, "its list misses spheres"),
    (huge, "declares shape"),
    (many, "not stored in one piece"),
    (outside, "is stored in another file"),
    (link, "is a link to elsewhere"),
    (loop, "groups lie more than"),
    (packed, "not stored in one piece"),
    (lambda file: file.attrs.modify("record", "[" * 100_000), "record"),
    (lambda file: file.attrs.modify("record", '{"at_rest": 3}'), "its record is not a JSON object"),
]


@pytest.mark.parametrize(("change", "words"), CHANGES, ids=[words for _, words in CHANGES])
def test_an_impossible_pack_is_refused_whoever_sealed_it(
    tmp_path: Path, change: Callable[[h5py.File], None], words: str
) -> None:
    with pytest.raises(gm.FileFormatError, match=words) as refused:
        gm.load_pack(changed(tmp_path, change))
    assert "changed.h5" in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_file_without_a_seal_is_refused(tmp_path: Path) -> None:
    """What another program wrote, or rewrote without the first 512 bytes."""
    bare = tmp_path / "bare.h5"
    bare.write_bytes(PACK.read_bytes()[BLOCK:])
    with pytest.raises(
        gm.FileFormatError, match=r"bare\.h5: not a readable HDF5 file: it is HDF5 without our checksum"
    ):
        gm.load_pack(bare)


def test_a_file_of_another_kind_is_refused_with_what_it_is_and_what_is_needed(tmp_path: Path) -> None:
    foreign, shifted, picture, text = (tmp_path / name for name in ("a.h5", "b.h5", "c.png", "d.json"))
    for path, block in ((foreign, 0), (shifted, 1024)):
        with h5py.File(path, "w", userblock_size=block) as file:
            file["x"] = np.arange(3)
    picture.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(range(256)) * 8)
    text.write_text("{}")
    for path in (foreign, shifted):
        with pytest.raises(gm.FileFormatError, match="it is HDF5 without our checksum, made or changed by another"):
            gm.load_pack(path)
    for path in (picture, text):
        with pytest.raises(gm.FileFormatError, match=r"not a readable HDF5 file: it is not HDF5 at all$"):
            gm.load_pack(path)
    for name, words in (
        ("gmem-recall/0.1", "this is a recall; a pack is needed"),
        ("x", "unknown here; a pack is needed"),
    ):
        with writing(tmp_path / "kind.h5", name):
            pass
        with pytest.raises(gm.FileFormatError, match=rf"kind\.h5: .*{words}"):
            gm.load_pack(tmp_path / "kind.h5")


def test_a_recall_keeps_its_waveforms_and_their_names_and_is_refused_when_its_parts_do_not_fit(tmp_path: Path) -> None:
    experiment = gm.Experiment(gm.load_pack(PACK), gm.words(1), t0=75.0, store=0.1, rest=0.1, hold=0.1)
    path, wrong = tmp_path / "recall.h5", tmp_path / "wrong.h5"
    found = gm.run(experiment)
    gm.save_recall(path, found)
    again = gm.load_recall(path)
    configuration = again.configuration
    np.testing.assert_array_equal(again.shear, np.asarray(experiment.signals.shear(found.u)).T)
    np.testing.assert_array_equal(again.p_sig, found.p_sig)
    assert configuration["signals"] == ["0", "1"]
    assert configuration["experiment"]["signals"] == {"kind": "words", "bits": 1, "pad": 2.0, "width": 1.0}
    for change, words in (
        (lambda file: put(file, "p_sig", file["p_sig"][:1]), r"'p_sig' has shape \[1, 256\]"),
        (lambda file: put(file, "fidelity", np.asarray(np.nan)), "fidelity holds numbers that are not finite"),
        (lambda file: put(file, "status", file["status"][()] + (1 << 20)), "its status has bits that gm.Status"),
        (lambda file: file.__delitem__("stages/readout"), "the stage 'readout' is missing"),
        (lambda file: file.attrs.modify("configuration", "{}"), "its configuration has no 'pack'"),
    ):
        wrong.write_bytes(path.read_bytes())
        with h5py.File(wrong, "r+") as file:
            change(file)
        seal(wrong)
        with pytest.raises(gm.FileFormatError, match=words):
            gm.load_recall(wrong)
