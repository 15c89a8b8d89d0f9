"""Result files say what they hold: units, names and axes on every array. Old ones are still read."""

import json
import runpy
from collections import OrderedDict
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from scenes import ROOT, TETRA_27

import gmem_jax as gm
from gmem_jax.design.kernel import MemoryKernel
from gmem_jax.design.stored import load_kernel, save_kernel
from gmem_jax.files import schemas
from gmem_jax.files.results import load_result, save_result
from gmem_jax.files.seal import seal
from gmem_jax.files.waveforms import load_design, load_target, save_waveforms
from gmem_jax.show.stages import QUANTITIES, stages_figure
from gmem_jax.simulation.stage import BINS

PACK = TETRA_27


@pytest.fixture(scope="module")
def stored(recalled: tuple[gm.Experiment, gm.Recall], tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("recall") / "recall.h5"
    gm.save_recall(file, recalled[1])
    return file


@pytest.fixture(scope="module")
def kernel(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, MemoryKernel]:
    file, random = tmp_path_factory.mktemp("kernel") / "kernel.h5", np.random.default_rng(0)
    centres, u = np.linspace(0.1, 0.9, 5), (np.arange(256) + 0.5) / 256
    made = MemoryKernel(u, centres, 0.2, random.normal(size=(5, 256)), random.normal(size=(5, 256)), 1e-3, 0.05)
    save_kernel(file, made, {"pack": "some"})
    return file, made


@pytest.fixture(scope="module")
def files(stored: Path, recalled: tuple[gm.Experiment, gm.Recall], kernel: tuple[Path, MemoryKernel]) -> list[Path]:
    stages = {"cycle 1: compress": recalled[1].stages["compress"], "rest": recalled[1].stages["rest"]}
    pack = kernel[0].with_name("pack.h5")
    gm.save_pack(pack, gm.load_pack(PACK), stages)
    return [stored, kernel[0], pack]


def test_every_array_has_units_a_description_and_a_scale_for_each_dimension(files: list[Path]) -> None:
    for path in files:
        with h5py.File(path) as file:
            found: list[h5py.Dataset] = []
            file.visititems(lambda _, item, found=found: found.append(item) if isinstance(item, h5py.Dataset) else None)
            for array in found:
                assert array.attrs["units"], array.name
                assert 3 < len(array.attrs["description"]) < 90, array.name
                for dimension, length in zip(array.dims, array.shape, strict=True):
                    assert array.is_scale or dimension[0].shape == (length,), array.name


def test_times_count_stages_that_were_not_recorded(
    stored: Path, recalled: tuple[gm.Experiment, gm.Recall], tmp_path: Path
) -> None:
    whole, left_out = recalled[1], "hold"
    stages = OrderedDict((name, sample) for name, sample in whole.stages.items() if name != left_out)
    protocol = gm.Protocol([replace(stage, recorded=stage.name != left_out) for stage in whole.protocol])
    recall = replace(whole, stages=stages, protocol=protocol)
    gm.save_recall(tmp_path / "some.h5", recall)
    with h5py.File(stored) as file, h5py.File(tmp_path / "some.h5") as some:
        assert left_out not in some["stages"]
        for name in stages:
            np.testing.assert_array_equal(some[f"stages/{name}/time"], file[f"stages/{name}/time"])
        last = some["stages/readout/time"][-1]
    assert last == sum(stage.bins for stage in protocol if stage.name != "readout-2") / BINS
    pytest.importorskip("xarray")
    for one in (recall, gm.load_recall(tmp_path / "some.h5")):
        table = gm.to_xarray(one)
        assert float(table.time[table.stage == "readout"][-1]) == last
        (panel,) = stages_figure(one.stages, QUANTITIES["phi"], "", begins=one.protocol.begins, t0=2.0).panels
        spans = {name: span for *span, name in panel.spans}
        np.testing.assert_allclose(spans["readout"][1], 2.0 * last)
        left = 2.0 * protocol.stage(left_out).bins / BINS
        np.testing.assert_allclose(spans["decompress"][0], spans["compress"][1] + left)


def test_xarray_opens_the_files_without_us(files: list[Path], recalled: tuple[gm.Experiment, gm.Recall]) -> None:
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf")
    for path in files:
        xarray.open_datatree(path, engine="h5netcdf").close()
    with xarray.open_dataset(files[0], engine="h5netcdf") as data:
        np.testing.assert_array_equal(data.p_sig.sel(signal="1"), recalled[1].p_sig[1])
        np.testing.assert_array_equal(data.shear.sel(u=0.4, method="nearest"), recalled[1].shear[:, 102])
        assert data.p_sig.attrs["units"] == "E"
    with xarray.open_dataset(files[0], engine="h5netcdf", group="stages/readout") as data:
        assert data.pressure.dims == ("time", "axis", "replica")
        assert float(data.time[-1]) == recalled[0].protocol.bins / 256
        assert float(data.u[-1]) == 0.0


def test_the_recorded_u_is_that_of_the_protocol(stored: Path, recalled: tuple[gm.Experiment, gm.Recall]) -> None:
    for found in (recalled[1], gm.load_recall(stored)):
        assert found.protocol == recalled[0].protocol
        for stage in found.protocol:
            passed = np.arange(1, stage.bins + 1)[:, None] / stage.bins
            u = found.stages[stage.name].u
            np.testing.assert_array_equal(
                u, np.broadcast_to(stage.start + (stage.stop - stage.start) * passed, u.shape)
            )


def test_a_recall_is_an_xarray_with_all_stages_in_a_row(
    stored: Path, recalled: tuple[gm.Experiment, gm.Recall]
) -> None:
    pytest.importorskip("xarray")
    experiment, found = recalled
    data = gm.to_xarray(gm.load_recall(stored))
    assert list(data.signal.values) == ["0", "1"]
    readout = data.sel(time=data.stage == "readout")
    np.testing.assert_array_equal(readout.pressure, found.stages["readout"].pressure)
    before = data.sel(time=data.stage == "compress").filling
    np.testing.assert_array_equal(before.isel(replica=2), found.stages["compress"].filling[:, 0])
    assert data.sizes["time"] == experiment.protocol.bins
    assert np.all(np.diff(data.time) > 0.0)
    assert (data.attrs["mu"], data.attrs["t0"]) == (1.0, 75.0)
    assert all(array.attrs["units"] and array.attrs["description"] for array in data.data_vars.values())


def test_the_csv_of_a_recall_has_a_column_for_each_signal(
    stored: Path, recalled: tuple[gm.Experiment, gm.Recall]
) -> None:
    head, *rows = gm.to_csv(gm.load_recall(stored)).splitlines()
    assert head == "u,p_sig of 0 (E),p_sig of 1 (E)"
    np.testing.assert_array_equal(np.loadtxt(rows, delimiter=",")[:, 1:].T, recalled[1].p_sig)


def test_a_kernel_survives_its_file_and_is_refused_if_it_is_not_that_of_its_recalls(
    tmp_path: Path, kernel: tuple[Path, MemoryKernel]
) -> None:
    path, made = kernel
    again, configuration = load_kernel(path)
    np.testing.assert_array_equal(again.odd, made.odd)
    assert (again.width, again.gamma0, configuration) == (0.2, 1e-3, {"pack": "some"})
    wrong = tmp_path / "wrong.h5"
    wrong.write_bytes(path.read_bytes())
    with h5py.File(wrong, "r+") as file:
        file["odd"][2] *= 1.1
    seal(wrong)
    with pytest.raises(gm.FileFormatError, match="its kernel is not that of its recalls"):
        load_kernel(wrong)


def test_a_json_result_says_what_its_fields_are_and_what_is_none_is_refused(tmp_path: Path) -> None:
    run = {"seconds": 1.0, "status": 0, "configuration": {}}
    slopes = {"waveform": [[1.0], [2.0, float("nan")]], "gamma0": 3.0}
    result = {"pack": "a", "fidelity": 0.5, "places": [[0.1], [0.2, 0.3]], "gradient": slopes, **run}
    path = tmp_path / "gradient.json"
    save_result(path, schemas.GRADIENT, result)
    stored = json.loads(path.read_text())
    assert stored["about"]["seconds"] == "wall time of the call that finished the run (s)"
    schema, again = load_result(path)
    assert (schema, again["gradient"]["waveform"][1]) == (schemas.GRADIENT, [2.0, None])
    for change, words in (
        ({"fidelity": "high"}, "an impossible 'fidelity'"),
        (
            {"schema": "gmem-other/1"},
            "its schema is 'gmem-other/1', which is unknown here; a gradient or a tuned drive or",
        ),
        ({"schema": None}, "it has no schema; .* is needed"),
        ({"schema": "gmem-pack/0.1"}, "this is a pack; a gradient or .* is needed"),
        ({"gradient": {"waveform": [[1.0]]}}, "'gradient/gamma0' is missing"),
    ):
        path.write_text(json.dumps({**stored, **change}))
        with pytest.raises(gm.FileFormatError, match=words):
            load_result(path)


def test_a_designed_file_says_how_its_design_went(tmp_path: Path) -> None:
    path = tmp_path / "designed.csv"
    way = {"pack": "a", "before": 0.5, "fidelity": 0.9, "gain": 0.1, "history": (0.5, 0.8)}
    save_waveforms(path, gm.waveform(np.ones((6, 4))), gm.six_signals(), design=way)
    assert load_design(path) == {**way, "history": [0.5, 0.8]}
    assert load_target(path) is not None
    assert gm.load_waveforms(path).shape == (6, 4)
    save_waveforms(path, gm.waveform(np.ones((6, 4))), gm.six_signals())
    assert load_design(path) == {}


def test_the_page_of_the_files_is_that_of_the_tables() -> None:
    page = ROOT / "docs" / "files.md"
    made = runpy.run_path(str(ROOT / "docs" / "make" / "files_page.py"))["page"]()
    assert page.read_text() == made, "python docs/make/files_page.py"
