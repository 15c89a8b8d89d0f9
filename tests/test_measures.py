"""What is said of each signal by itself."""

import numpy as np

import gmem_jax as gm
from gmem_jax.files.measures import of_each
from gmem_jax.show.tables import summary


def test_each_signal_has_measures_of_its_own(recalled: tuple[gm.Experiment, gm.Recall]) -> None:
    experiment, recall = recalled
    configuration = gm.resolved(experiment, 1.0)
    found = of_each(recall, configuration)
    for number, (p_sig, integral) in enumerate(zip(recall.p_sig, recall.J, strict=True)):
        template = 0.05 * 1e-3 * integral
        gain = (template @ p_sig) / (template @ template)
        miss = p_sig - gain * template
        np.testing.assert_allclose(found["signal_gain"][number], gain, rtol=1e-12)
        np.testing.assert_allclose(
            found["signal_fidelity"][number], 1.0 - np.sqrt((miss @ miss) / (p_sig @ p_sig)), rtol=1e-9
        )
        assert abs(found["signal_correlation"][number]) <= 1.0
    rows = summary(recall, configuration)["signals"]
    assert [row["signal"] for row in rows] == ["0", "1"]
    assert rows[1]["fidelity"] == found["signal_fidelity"][1]
