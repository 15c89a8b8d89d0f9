"""Files are complete or absent, and say what is wrong with them."""

import subprocess
import sys
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import jax
import numpy as np
import pytest
from scenes import TETRA_27

import gmem_jax as gm
from gmem_jax.experiment.pack import stack
from gmem_jax.experiment.record import to_dict
from gmem_jax.files.atomic import atomic
from gmem_jax.files.checkpoints import Checkpoints, load_part, locked, save_part
from gmem_jax.files.configuration import from_dict
from gmem_jax.files.exporters import frames_of_pack
from gmem_jax.files.frames import load_frames
from gmem_jax.files.hdf5 import writing
from gmem_jax.files.packs import load_stages
from gmem_jax.files.waveforms import save_waveforms
from gmem_jax.physics.state import Grains, State, still_box
from gmem_jax.simulation.sample import MEASURED, Sample

PACK = TETRA_27
CYCLE = ("rest", "compress", "hold", "decompress")


def test_a_pack_survives_the_file_bit_for_bit(tmp_path: Path) -> None:
    pack = gm.load_pack(PACK)
    gm.save_pack(tmp_path / "again.h5", pack)
    again = gm.load_pack(tmp_path / "again.h5")
    for key in ("position", "quaternion", "lower", "upper", "delta0", "ringing_period"):
        np.testing.assert_array_equal(getattr(pack, key), getattr(again, key))
    for key in ("first", "second", "valid", "incidence", "reference", "reach"):
        np.testing.assert_array_equal(getattr(pack.pairs, key), getattr(again.pairs, key))
    assert again.info == pack.info
    assert again.clump.isotropic


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda pack: replace(pack, name="two\nlines"), "its name"),
        (lambda pack: replace(pack, name="n" * 201), "its name"),
        (lambda pack: replace(pack, clump=replace(pack.clump, shape="\x1b[2J")), "its name or that of its grain"),
        (lambda pack: replace(pack, record="[]"), "its record is not a JSON object"),
        (lambda pack: replace(pack, position=2.0 * pack.position), "a grain lies outside the box"),
        (lambda pack: replace(pack, quaternion=1.1 * pack.quaternion), "a quaternion is not of length 1"),
        (lambda pack: replace(pack, ringing_period=pack.ringing_period * -1.0), "its ringing period is -19.6"),
        (lambda pack: stack([pack, pack]), r"'position' has shape \[2, 27, 3\]"),
        (lambda pack: replace(pack, position=pack.position.astype("float32")), "its numbers are in single precision"),
    ],
)
def test_a_pack_that_could_not_be_read_is_not_written(
    tmp_path: Path, change: Callable[[gm.Pack], gm.Pack], reason: str
) -> None:
    path = tmp_path / "a.h5"
    with pytest.raises(gm.FileFormatError, match=f"is not written, since it could not be read: {reason}"):
        gm.save_pack(path, change(gm.load_pack(PACK)))
    assert not list(tmp_path.iterdir())


def test_frames_and_stages_that_could_not_be_read_are_not_written(tmp_path: Path) -> None:
    pack = gm.load_pack(PACK)
    frames = frames_of_pack(pack)
    for wrong, reason in (
        (replace(frames, position=np.nan * frames.position), "not finite"),
        (replace(frames, stages=("one", "two")), "must have one time and one stage each"),
        (replace(frames, stages=("two\nlines",)), "a list of names"),
    ):
        with pytest.raises(gm.FileFormatError, match=reason):
            gm.save_pack(tmp_path / "a.h5", pack, frames=wrong)
    with pytest.raises(gm.FileFormatError, match="'gas/1' is no name of a stage"):
        gm.save_pack(tmp_path / "a.h5", pack, {"gas/1": Sample(*[np.zeros(1)] * len(MEASURED))})
    assert not list(tmp_path.iterdir())
    gm.save_pack(tmp_path / "a.h5", pack, frames=frames)
    assert load_frames(tmp_path / "a.h5").count == 1


def test_a_pack_with_another_ringing_period_is_another_pack() -> None:
    pack = gm.load_pack(PACK)
    experiment = to_dict(gm.Experiment(pack, gm.six_signals()))
    other = replace(pack, ringing_period=1.1 * pack.ringing_period)  # F over T1 would be another
    assert from_dict(experiment, pack).pack is pack
    with pytest.raises(gm.FileFormatError, match="not the pack that this was made with"):
        from_dict(experiment, other)


def test_a_truncated_file_is_refused(tmp_path: Path) -> None:
    broken = tmp_path / "broken.h5"
    for length, words in (
        (3000, "its checksum does not fit"),
        (300, "its checksum"),
        (5, "it was cut off"),
        (0, "it is empty"),
    ):
        broken.write_bytes(PACK.read_bytes()[:length])
        with pytest.raises(gm.FileFormatError, match=words):
            gm.load_pack(broken)


def test_another_schema_is_refused_and_named(tmp_path: Path) -> None:
    other = tmp_path / "other.h5"
    with writing(other, "gmem-pack/99"):
        pass
    with pytest.raises(gm.FileFormatError, match=r"'gmem-pack/99', of another version; this one reads gmem-pack/0\.1"):
        gm.load_pack(other)


def test_a_file_without_its_data_is_refused(tmp_path: Path) -> None:
    empty = tmp_path / "empty.h5"
    with writing(empty, "gmem-pack/0.1"):
        pass
    with pytest.raises(gm.FileFormatError, match="incomplete"):
        gm.load_pack(empty)


def test_an_unknown_pack_name_lists_the_shipped_ones() -> None:
    with pytest.raises(FileNotFoundError, match="tetra-325-a"):
        gm.load_pack("no-such-pack")


def test_a_place_where_no_file_can_be_is_named_as_it_was_given(tmp_path: Path) -> None:
    for place, told in (
        ("none/a.csv", r"none/a\.csv: folder .*none does not exist$"),
        ("", ": is a folder, and a file is needed; move it away"),
    ):
        with pytest.raises(OSError, match=told):
            gm.save_waveforms(tmp_path / place, gm.six_signals())
    assert list(tmp_path.iterdir()) == []


def test_a_failed_write_leaves_nothing_behind(tmp_path: Path) -> None:
    def write() -> None:
        with atomic(tmp_path / "file") as temporary:
            temporary.write_text("half")
            raise RuntimeError("disk on fire")

    with pytest.raises(RuntimeError, match="disk on fire"):
        write()
    assert list(tmp_path.iterdir()) == []


def test_a_failed_overwrite_keeps_the_old_file(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("old")

    def write() -> None:
        with atomic(tmp_path / "file") as temporary:
            temporary.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        write()
    assert (tmp_path / "file").read_text() == "old"


def test_waveforms_are_read_from_csv_with_or_without_header_and_from_npy(tmp_path: Path) -> None:
    samples = np.array([[0.0, 1.0, 0.5], [1.0, -1.0, 0.25]])
    (tmp_path / "plain.csv").write_text("0,1\n1,-1\n0.5,0.25\n")
    (tmp_path / "header.csv").write_text("one,two\n0,1\n1,-1\n0.5,0.25\n")
    np.save(tmp_path / "both.npy", samples)
    for name in ("plain.csv", "header.csv", "both.npy"):
        np.testing.assert_array_equal(gm.load_waveforms(tmp_path / name), samples)


def test_waveforms_survive_their_file_bit_for_bit(tmp_path: Path) -> None:
    signals = gm.waveform(np.random.default_rng(0).normal(size=(3, 7)))
    save_waveforms(tmp_path / "own.csv", signals)
    np.testing.assert_array_equal(gm.load_waveforms(tmp_path / "own.csv"), np.asarray(signals.nodes)[:, 1:-1])


def test_a_part_that_is_kept_is_not_run_again(tmp_path: Path) -> None:
    ran: list[int] = []

    def work(_: object) -> dict[str, np.ndarray]:
        ran.append(len(ran))
        return {"answer": np.arange(3) + len(ran)}

    first = Checkpoints(tmp_path / "parts", {"seed": 1})("one", work)
    again = Checkpoints(tmp_path / "parts", {"seed": 1})
    np.testing.assert_array_equal(again("one", work)["answer"], first["answer"])
    assert (ran, again.finished()) == ([0], 1)
    again("two", work)
    assert (ran, again.finished()) == ([0, 1], 2)
    again.discard()
    assert list(tmp_path.iterdir()) == []


def test_parts_of_another_run_are_refused(tmp_path: Path) -> None:
    Checkpoints(tmp_path / "parts", {"seed": 1, "pack": "a"})
    Checkpoints(tmp_path / "parts", {"seed": 1, "pack": "b"})(
        "one", lambda _: np.zeros(1)
    )  # nothing was finished: no matter
    with pytest.raises(gm.FileFormatError, match=r"another pack \('b', now 'a'\)"):
        Checkpoints(tmp_path / "parts", {"seed": 1, "pack": "a"})
    assert Checkpoints(tmp_path / "parts", {"seed": 1, "pack": "a"}, restart=True).finished() == 0


def test_a_part_is_a_table_of_arrays(tmp_path: Path) -> None:
    """What cannot be told from its bytes alone is refused: no code."""
    cell = still_box(np.zeros((3, 1)), np.ones((3, 1)), (True, False, True))
    grains = Grains(*(np.full((2, 3, 1), float(k)) for k in range(6)))
    state = State(grains, (np.ones(4), ()), np.zeros(1, np.int32), cell=cell)
    tree = (OrderedDict(rest=state, compress=state), np.arange(3))
    save_part(tmp_path / "part.npz", tree)
    found = load_part(tmp_path / "part.npz")
    assert jax.tree.structure(found) == jax.tree.structure(tree)
    assert list(found[0]) == ["rest", "compress"]
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(tree), strict=True):
        np.testing.assert_array_equal(one, other)
    with pytest.raises(TypeError, match="cannot be kept"):
        save_part(tmp_path / "part.npz", {"function": print})


def test_an_output_belongs_to_one_run_at_a_time(tmp_path: Path) -> None:
    output = tmp_path / "out.h5"
    other = "from pathlib import Path; import sys; from gmem_jax.files.checkpoints import locked\n"
    other += "with locked(Path(sys.argv[1])): pass"
    with locked(output):
        refused = subprocess.run([sys.executable, "-c", other, str(output)], capture_output=True, text=True)
        assert "another run is writing it" in refused.stderr
    assert subprocess.run([sys.executable, "-c", other, str(output)]).returncode == 0
    assert list(tmp_path.iterdir()) == []


def test_a_column_in_npy_is_refused_with_what_a_row_is(tmp_path: Path) -> None:
    np.save(tmp_path / "column.npy", np.ones((255, 1)))
    with pytest.raises(gm.FileFormatError, match=r"found \(255, 1\), where a row of .npy"):
        gm.load_waveforms(tmp_path / "column.npy")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("0,1\n1\n", "not a readable table"),
        ("0.5\n", "at least 2 samples"),
        ("0\nnan\n1\n", "sample 2 of signal 1 is not a finite"),
        ("", "at least 2 samples"),
        ("a\nb\nc\n", "not a readable table"),
    ],
)
def test_a_bad_waveform_file_is_refused(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "bad.csv").write_text(text)
    with pytest.raises(gm.FileFormatError, match=words):
        gm.load_waveforms(tmp_path / "bad.csv")


@pytest.mark.parametrize("name", gm.list_packs())
def test_every_shipped_pack_is_at_rest_and_says_how_it_was_made(name: str) -> None:
    pack, (_, grains, letter) = gm.load_pack(name), name.split("-")
    assert (pack.name, pack.grains) == (name, int(grains))
    assert pack.info["recipe"]["seed"] == "abcde".index(letter) + 1
    assert pack.info["at_rest"]["largest_speed"] <= pack.info["recipe"]["quiet"]
    assert 20.0 < float(pack.ringing_period) < 200.0
    assert set(pack.info["material"]) == {entry.name for entry in fields(gm.Material)}


@pytest.mark.parametrize("name", ["tetra-325-a", "tetra-1024-b"])
def test_shipped_packs_keep_the_stages_of_their_preparation(name: str) -> None:
    stages = load_stages(name)
    assert list(stages) == [*(f"cycle {number}: {kind}" for number in (1, 2) for kind in CYCLE), "rest"]
    for kind, ends in {"compress": (1 / 256, 1.0), "hold": (1.0, 1.0), "decompress": (255 / 256, 0.0)}.items():
        np.testing.assert_array_equal(stages[f"cycle 2: {kind}"].u[[0, -1], 0], ends)
