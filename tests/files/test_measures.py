"""What is said of each signal by itself, and of what a file will take before it is written."""

from pathlib import Path

import numpy as np

import gmem_jax as gm
from gmem_jax.files.measures import of_each
from gmem_jax.files.sizes import in_time, pack_bytes, recall_bytes
from gmem_jax.show.numbers import summary


def test_each_signal_has_measures_of_its_own(recalled: tuple[gm.Experiment, gm.Recall]) -> None:
    _, recall = recalled
    found = of_each(recall)
    for number, (p_sig, integral) in enumerate(zip(recall.p_sig, recall.J, strict=True)):
        template = 0.05 * 1e-3 * integral
        gain = (template @ p_sig) / (template @ template)
        miss = p_sig - gain * template
        np.testing.assert_allclose(found["signal_gain"][number], gain, rtol=1e-12)
        np.testing.assert_allclose(
            found["signal_fidelity"][number], 1.0 - np.sqrt((miss @ miss) / (p_sig @ p_sig)), rtol=1e-9
        )
        assert abs(found["signal_correlation"][number]) <= 1.0
    rows = summary(recall)["signals"]
    assert [row["signal"] for row in rows] == ["0", "1"]
    assert rows[1]["fidelity"] == found["signal_fidelity"][1]


def test_files_take_about_the_bytes_that_were_foreseen(
    tmp_path: Path, recalled: tuple[gm.Experiment, gm.Recall]
) -> None:
    experiment, recall = recalled
    gm.save_recall(tmp_path / "recall.h5", recall)
    assert 0.8 < recall_bytes(experiment) / (tmp_path / "recall.h5").stat().st_size < 1.25
    for name in ("tetra-325-b", "tetra-3267-d"):
        size = (Path(gm.__file__).parent / "packs" / f"{name}.h5").stat().st_size
        assert 0.8 < pack_bytes(gm.load_pack(name).grains) / size < 1.25
    told = [in_time(seconds) for seconds in (0.2, 100.0, 130.0, 1e6)]
    assert told == ["some 1 s", "some 100 s", "some 2 min", "some 12 days"]
