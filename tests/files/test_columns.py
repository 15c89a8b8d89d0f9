"""Tables of waveforms as spreadsheets and instruments write them: what is read, what is said, what is refused."""

from pathlib import Path

import numpy as np
import pytest

import gmem_jax as gm


def loaded(folder: Path, text: str, **options: float) -> tuple[np.ndarray, list[str]]:
    """The samples of a CSV with this text, and what is said of them."""
    path, said = folder / "wave.csv", []
    path.write_text(text, encoding="utf-8")
    return gm.load_waveforms(path, told=said.append, **options), said


def table(*columns: np.ndarray, names: str, separator: str = ",") -> str:
    """A CSV."""
    rows = [separator.join(f"{value:.12g}" for value in row) for row in zip(*columns, strict=True)]
    return "\n".join([names, *rows]) + "\n"


TIME = np.linspace(0.0, 2.5, 201)
VOLTS = 0.3 + 0.5 * np.sin(TIME * 2.8) + 0.02 * np.random.default_rng(1).normal(size=TIME.size)
LAB = table(TIME, VOLTS, names="time (s),voltage (V)")

REFUSED = {
    "wave\n0,2\n0,5\n0,3\n": "decimal commas ('0,2'); write numbers with points",
    "0,2\n0,5\n0,3\n": "decimal commas ('0,2')",
    "0,2;0,3\n0,1;0,2\n": "decimal commas",
    '"0,2"\n"0,3"\n': "decimal commas",
    ",a\n0,0.2\n1,0.5\n2,0.3\n": "column 1 has no name, as row numbers have none",
    "Unnamed: 0,a\n0,0.2\n1,0.5\n2,0.3\n": "column 1 has no name",
    "index,a\n0,0.2\n1,0.5\n2,0.3\n": "column 1 ('index') rises by equal steps, as times and row numbers do",
    "0,0.2\n1,0.5\n2,0.3\n": "column 1 rises by equal steps",
    "a,b,c\n0.1,0.2\n0.4,0.5\n0.2,0.1\n": "3 names over 2 columns",
    "0.1 0.2\n0.3 0.4\n": "numbers separated by blanks ('0.3 0.4'); use commas",
    "time,t,a\n0,0,0\n1,1,1\n2,2,0\n": "columns time, t, a: need one axis (u or time) and one signal or more",
    "t\n0\n1\n2\n": "columns t: need one axis",
    "t,a\n": "a waveform needs at least 2 samples",
    "no,time,a\n1,0,0\n2,0.1,1\n3,0.3,0\n": "column 1 ('no') rises by equal steps",
    "t,a\n0,0\n1,1\n1,2\n3,0\n": "times must rise; sample 3 is not after the one before",
    "u,a\n0,0\n1,1\n2,0\n": "times from 0 to 2 lie outside 0 to 1",
    LAB: "signal 1 begins at 0.307 and ends at 0.665; a waveform is zero at both ends: bring it there",
    table(VOLTS, names="voltage"): "that a pack can hold: it is zero at both ends; bring it there, with taper = 0.1",
}


@pytest.mark.parametrize(("text", "words"), REFUSED.items(), ids=range(len(REFUSED)))
def test_a_table_that_would_be_taken_for_another_is_refused(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(gm.FileFormatError, match=r"wave\.csv: ") as refused:
        loaded(tmp_path, text)
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)


def test_columns_that_are_numbered_are_signals(tmp_path: Path) -> None:
    samples, _ = loaded(tmp_path, "t_1,t_2\n0.1,0.2\n0.4,0.3\n")
    assert samples.shape == (2, 2)


@pytest.mark.parametrize("name", ["time", "t", "Time (s)", "t [ms]", "time/s", "t_ms"])
def test_a_column_of_times_is_the_axis(tmp_path: Path, name: str) -> None:
    u = np.linspace(0.0, 1.0, 64)
    wave = np.sin(np.pi * u) ** 2
    samples, said = loaded(tmp_path, table(3.0 + 2.0 * u, wave, -wave, names=f"{name},a,b"))
    np.testing.assert_allclose(samples, np.stack([wave, -wave])[:, 1:-1], atol=1e-11)
    assert said == [f"{tmp_path / 'wave.csv'}: {name} from 3 to 5 is u from 0 to 1"]


@pytest.mark.parametrize("digits", [4, 5])
@pytest.mark.parametrize("name", ["x,CH1", "second,Volt"])
def test_times_that_an_instrument_rounded_are_no_waveform(tmp_path: Path, name: str, digits: int) -> None:
    times = np.round(0.1 + np.linspace(0.0, 0.1, 301), digits)  # steps of 3.3e-4: at 4 digits they are 3e-4 or 4e-4
    with pytest.raises(gm.FileFormatError, match="rises by equal steps"):
        loaded(tmp_path, table(times, np.sin(times) ** 2, names=name))


def test_a_column_of_u_places_the_samples(tmp_path: Path) -> None:
    u = np.array([0.25, 0.5, 0.75])
    samples, said = loaded(tmp_path, table(u, u * (1.0 - u), names="u,I"))
    np.testing.assert_allclose(samples, [u * (1.0 - u)], atol=1e-15)
    assert said == []


@pytest.mark.parametrize(("separator", "word"), [(";", "semicolons"), ("\t", "tabs")])
def test_another_separator_is_read_and_named(tmp_path: Path, separator: str, word: str) -> None:
    wave = np.array([0.2, 0.5, 0.3])
    samples, said = loaded(tmp_path, table(wave, -wave, names=separator.join("ab"), separator=separator))
    np.testing.assert_array_equal(samples, [wave, -wave])
    assert said == [f"{tmp_path / 'wave.csv'}: separated by {word}"]


def test_what_an_instrument_wrote_is_usable_on_request_and_what_was_done_is_said(tmp_path: Path) -> None:
    samples, said = loaded(tmp_path, LAB, smooth=0.05, taper=0.1, scale=True)
    assert np.abs(samples).max() == pytest.approx(1.0)
    assert np.abs(samples[0, [0, -1]]).max() < 0.01
    assert len(said) == 1
    for words in ("time (s) from 0 to 2.5 is u", "smoothed over 0.05 in u", "brought to zero within 0.1", "divided by"):
        assert words in said[0]
    gm.Experiment(gm.load_pack("tetra-325-a"), gm.waveform(samples))


def test_names_in_any_language_are_read_whatever_the_locale(tmp_path: Path) -> None:
    text = "größe,δ\n0.2,0.1\n0.5,0.3\n0.3,0.2\n"
    assert loaded(tmp_path, text)[0].shape == (2, 3)
    assert loaded(tmp_path, "\ufeff" + text)[0].shape == (2, 3)


def test_a_design_is_recalled_as_it_is_however_steep(tmp_path: Path) -> None:
    steep = gm.waveform(np.ones((6, 99)))
    gm.save_waveforms(tmp_path / "designed.csv", steep, gm.six_signals())
    assert gm.load_waveforms(tmp_path / "designed.csv").shape == (6, 99)
    gm.save_waveforms(tmp_path / "own.csv", steep)
    with pytest.raises(gm.FileFormatError, match="more than the 20% that a pack can hold"):
        gm.load_waveforms(tmp_path / "own.csv")
