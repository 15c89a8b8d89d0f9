"""The report page and the 3D view: what they show, that they need nothing from elsewhere, that a browser draws them."""

import base64
import json
import shutil
import sys
import time
import zlib
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from scenes import TETRA_27, gmem

import gmem_jax as gm
from gmem_jax.experiment import analysis
from gmem_jax.files.exporters import frames_of_pack
from gmem_jax.show import render_plotly
from gmem_jax.show.figure import Image
from gmem_jax.show.numbers import summary
from gmem_jax.show.recalls import recall_figure, signals_figure
from gmem_jax.show.report import Report
from gmem_jax.show.scene import Colouring, links, packed, quantities
from gmem_jax.simulation.frames import Frames
from gmem_jax.simulation.sample import MEASURED, Sample

PACK_FILE = TETRA_27
PACK = gm.load_pack(PACK_FILE)
TWO = gm.Bumps(jnp.asarray([[1.0, -0.6], [0.3, 1.0]]), jnp.asarray([[0.3, 0.7]] * 2), 0.3)
EXPERIMENT = gm.Experiment(PACK, TWO, gm.Hooke(mu=0.3), t0=75.0, rest=0.05, hold=0.05, store=0.1)
RECORD = json.dumps(gm.describe(EXPERIMENT, 1.0))
HOSTILE = "<script>alert(1)</script>"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made, recall = tmp_path_factory.mktemp("report"), made_up()
    gm.save_recall(made / "recall.h5", recall)
    gm.save_recall(made / "without.h5", replace(recall, frames=None))
    gm.save_pack(made / "hostile.h5", replace(PACK, name=HOSTILE))
    return made


@pytest.fixture(scope="module")
def page(folder: Path) -> Path:
    pytest.importorskip("plotly")
    report = Report()
    for name in ("recall.h5", "hostile.h5", "without.h5"):
        report.add(str(folder / name))
    path = folder / "report.html"
    path.write_text(report.page(f"report of {HOSTILE}"), encoding="utf-8")
    return path


def two_rods(stretch: float = 1.0) -> Frames:
    """Two grains of two spheres, one above the other, that touch twice; everything stretched along x and y."""
    place = np.array([[0.2, 0.1, 1.0], [0.2, 0.1, 2.9]]) * [stretch, stretch, 1.0]
    return Frames(
        time=np.zeros(1),
        u=np.zeros(1),
        position=place[None],
        quaternion=np.tile([1.0, 0.0, 0.0, 0.0], (1, 2, 1)),
        lower=np.array([[-2.0 * stretch, -2.0 * stretch, 0.0]]),
        upper=np.array([[2.0 * stretch, 2.0 * stretch, 4.0]]),
        start=np.array([0, 2]),
        spheres=np.array([[0, 2], [1, 3]]),
        normal_force=np.array([1.0, 2.0]),
        friction_force=np.array([[0.3, 0.0, 0.0], [0.1, 0.0, 0.0]]),
        offsets=np.array([[0.5, 0.0, 0.0], [-0.5, 0.0, 0.0]]),
        stages=("rest",),
    )


def one_after_the_other(*some: Frames) -> Frames:
    alike = {"offsets": some[0].offsets, "stages": tuple(one.stages[0] for one in some)}
    alike["start"] = np.cumsum([0, *(len(one.spheres) for one in some)])
    parts = {
        name: np.concatenate([getattr(one, name) for one in some])
        for name in vars(some[0])
        if name not in ("offsets", "stages", "start", "signal", "radii", "sizes", "wall_friction", "periodic")
    }
    return Frames(**parts, **alike)


def squeezed() -> Frames:
    """The pack, and three times the same in a smaller box, where a grain has moved by itself and contacts rub."""
    rest = frames_of_pack(PACK)

    def after(number: int) -> Frames:
        shrink = np.array([1.0 - 0.01 * number, 1.0 - 0.01 * number, 1.0])
        position = rest.position * shrink
        position[0, 5] += 0.02 * number
        rubbing = np.tile([0.1 * number, 0.0, 0.0], (len(rest.spheres), 1)) * rest.normal_force[:, None]
        walls = {"lower": rest.lower * shrink, "upper": rest.upper * shrink}
        when = {"time": np.array([100.0 * number]), "u": np.array([number / 3]), "stages": ("encode",)}
        return replace(rest, position=position, friction_force=rubbing, **walls, **when)

    return one_after_the_other(rest, after(1), after(2), after(3))


def made_up() -> gm.Recall:
    """A recall of two signals as none was ever measured: nothing is run for it."""
    integral = np.asarray(EXPERIMENT.integral())
    u = (np.arange(256) + 0.5) / 256
    p_sig = 0.3 * float(EXPERIMENT.scale) * (integral + 0.1 * np.sin(40 * u))
    stages, wide = OrderedDict(), 1
    for stage in EXPERIMENT.protocol:
        wide = 3 if stage.drives else wide
        slope = np.linspace(1.0, 2.0, stage.bins)[:, None] * np.linspace(1.0, 1.01, wide)
        vectors = {name: 1e-3 * np.repeat(slope[:, None], 3, axis=1) for name in ("pressure", "lengths")}
        at = np.broadcast_to(np.linspace(stage.start, stage.stop, stage.bins)[:, None], slope.shape)
        stages[stage.name] = Sample(**dict.fromkeys(MEASURED, slope) | vectors | {"u": at})
    numbers: dict[str, Any] = {name: np.asarray(0.3) for name in ("gain", "fidelity", "dt")}
    numbers |= {"windowed_gain": np.asarray(0.31), "windowed_fidelity": np.asarray(0.35), "window": np.asarray(40.0)}
    per_replica = {"residual_speed": np.full(3, 1e-4), "status": np.array([0, 0, int(gm.Status.RINGING)])}
    curves = {"u": u, "shear": integral, "J": integral, "p_sig": p_sig, "rounding": np.full(2, 1e-16)}
    return gm.Recall(
        **numbers,
        **per_replica,
        **curves,
        stages=stages,
        protocol=EXPERIMENT.protocol,
        reads=("readout",),
        channels=("xy",),
        frames=squeezed(),
        record=RECORD,
    )


def test_packs_stand_in_one_table_only_if_nothing_else_differs(folder: Path, tmp_path: Path) -> None:
    recall, other = replace(made_up(), frames=None), replace(PACK, position=PACK.position + 1e-6)
    for name, changes in {"pack": {}, "law": {"friction.stiffness": 0.2}, "rests": {"rest": 0.1}}.items():
        experiment = gm.replace(EXPERIMENT, {"pack": other, **changes})
        gm.save_recall(tmp_path / f"{name}.h5", recall.described(gm.describe(experiment, 1.0)))

    def together(*paths: Path) -> bool:
        report = Report()
        for path in paths:
            report.add(str(path))
        return "mean ± SD (2)" in report.page("two")

    assert together(folder / "without.h5", tmp_path / "pack.h5")
    assert not together(folder / "without.h5", folder / "without.h5")  # once is enough
    assert not together(folder / "without.h5", tmp_path / "law.h5")
    assert not together(folder / "without.h5", tmp_path / "rests.h5")


def test_colours_end_somewhere_though_nothing_touches() -> None:
    assert Colouring("force on a grain", "N", np.zeros((1, 0))).top == 1.0


def unpacked(text: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """As `view.js` does it."""
    content = zlib.decompress(base64.b64decode(text))
    end = content.index(b"\n")
    scene, at, arrays = json.loads(content[:end]), -(-(end + 1) // 4) * 4, {}
    for row in scene["arrays"]:
        raw = np.frombuffer(content, "<" + row["kind"], row["length"], at)
        at += -(-raw.nbytes // 4) * 4
        arrays[row["name"]] = row["low"] + row["step"] * raw if "step" in row else raw
    assert at == len(content)
    return scene, arrays


def test_contacts_of_one_pair_of_grains_are_one_link_with_their_sum() -> None:
    found = links(two_rods())
    assert found.grains.tolist() == [[0, 1]]
    np.testing.assert_allclose(found.force, np.hypot(3.0, 0.4), rtol=1e-12)  # rounding


def test_forces_in_a_pack_at_rest_balance_on_every_grain_that_touches_no_wall() -> None:
    pack = gm.load_pack("tetra-325-a")
    rest = frames_of_pack(pack)
    centres = rest.centres(0)
    one, other = rest.spheres.T
    normal = (centres[other] - centres[one]) / np.linalg.norm(centres[other] - centres[one], axis=1, keepdims=True)
    total = np.zeros((pack.grains, 3))
    np.add.at(total, other // 4, rest.normal_force[:, None] * normal)
    np.add.at(total, one // 4, -rest.normal_force[:, None] * normal)
    at_wall = np.any((centres < rest.lower + 1.0) | (centres > rest.upper - 1.0), axis=1).reshape(-1, 4).any(axis=1)
    assert np.sum(~at_wall) > 100
    # What is left moves the grains: shipped packs creep a little.
    assert np.linalg.norm(total[~at_wall], axis=1).max() < 1e-2 * rest.normal_force.mean()
    coloured = {one.label: one for one in quantities(rest, links(rest), 1.0)}
    assert "friction force, sum over contacts" not in coloured
    assert coloured["coordination"].values.mean() == pytest.approx(pack.info["at_rest"]["coordination"], rel=1e-12)


def test_forces_through_the_faces_of_a_periodic_pack_are_along_the_nearest_images() -> None:
    rest = frames_of_pack(gm.load_pack(TETRA_27.with_name("periodic-27.h5")))
    found, (one, other) = links(rest), rest.spheres.T
    lengths, apart = rest.upper[0] - rest.lower[0], np.diff(rest.centres(0)[rest.spheres], axis=1)[:, 0]
    images = np.asarray([[i, j, k] for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)]) * lengths
    every = apart[:, None] + images
    nearest = np.take_along_axis(every, np.linalg.norm(every, axis=2).argmin(axis=1)[:, None, None], axis=1)[:, 0]
    assert np.any(nearest != apart)
    force = -rest.normal_force[:, None] * nearest / np.linalg.norm(nearest, axis=1, keepdims=True)
    for (first, second), size in zip(found.grains, found.force, strict=True):
        of_pair = ([first, second] == np.sort([one // 4, other // 4], axis=0).T).all(axis=1)
        sign = np.where(one[of_pair] // 4 == first, 1.0, -1.0)[:, None]
        np.testing.assert_allclose(size, np.linalg.norm((sign * force[of_pair]).sum(axis=0)), rtol=1e-12)


def test_stresses_are_in_pascals_of_the_experiments_own_material() -> None:
    soft = made_up()
    own = {**soft.configuration["experiment"], "material": {"modulus": 1e9}}
    stiff = soft.described({**soft.configuration, "experiment": own})
    for key in ("pressure_pa", "largest_signal_pa"):
        np.testing.assert_allclose(summary(stiff)[key], 100.0 * np.asarray(summary(soft)[key]), rtol=1e-12)
    for picture in ("signals", "all", "pressure", "p_z"):
        curves = [recall_figure(each, picture).panels[0].marks[0] for each in (soft, stiff)]
        values = [np.asarray(curve.values if isinstance(curve, Image) else curve.y) for curve in curves]
        assert np.any(values[0])
        np.testing.assert_allclose(values[1], 100.0 * values[0], rtol=1e-12)
    alike = [recall_figure(each, "phi").panels[0].marks[0].y for each in (soft, stiff)]
    np.testing.assert_array_equal(*alike)


def test_grains_carried_along_with_the_box_have_no_non_affine_displacement() -> None:
    frames = one_after_the_other(two_rods(), two_rods(0.9))
    coloured = {one.label: one.values for one in quantities(frames, links(frames), 1.0)}
    np.testing.assert_allclose(coloured["displacement"][1], 0.1 * np.hypot(0.2, 0.1), rtol=1e-12)
    np.testing.assert_allclose(coloured["non-affine displacement"], 0.0, atol=1e-15)
    np.testing.assert_allclose(coloured["friction force, sum over contacts"], 400.0, rtol=1e-12)  # mN


def test_a_scene_is_read_back_as_it_was() -> None:
    frames = squeezed()
    scene, arrays = unpacked(packed(frames, list(frames.stages)))
    extent = float((frames.upper - frames.lower).max())
    for name in ("position", "lower", "upper"):
        np.testing.assert_allclose(arrays[name], np.ravel(getattr(frames, name)), atol=extent / 65535)  # of 16 bits
    network = links(frames)
    np.testing.assert_array_equal(arrays["start"], network.start)
    np.testing.assert_array_equal(arrays["ends"], network.grains.ravel())
    assert (scene["grains"], len(scene["spheres"]), len(scene["captions"])) == (27, 4, 4)
    assert [sphere[3] for sphere in scene["spheres"]] == [1.0] * 4
    np.testing.assert_array_equal(arrays["sizes"], np.ones(27))
    assert [one["label"] for one in scene["quantities"]][:2] == ["displacement", "non-affine displacement"]


def test_errors_over_signals_are_those_of_leaving_each_out() -> None:
    random = np.random.default_rng(1)
    integral = random.normal(size=(5, 40))
    signal, scale = 0.3 * integral + 0.1 * random.normal(size=(5, 40)), 0.7
    each = []
    for kept in (np.delete(np.arange(5), out) for out in range(5)):
        template = scale * integral[kept]
        gain = np.sum(template * signal[kept]) / np.sum(template**2)
        miss = np.sum((signal[kept] - gain * template) ** 2)
        each.append([gain, 1.0 - np.sqrt(miss / np.sum(signal[kept] ** 2))])
    expected = np.sqrt(4 / 5 * np.sum((each - np.mean(each, axis=0)) ** 2, axis=0))
    np.testing.assert_allclose(analysis.errors_over_signals(signal, integral, scale), expected, rtol=1e-9)
    assert np.isnan(analysis.errors_over_signals(signal[:1], integral[:1], scale)).all()


def test_no_curve_of_the_recalled_signals_is_cut_off() -> None:
    pytest.importorskip("plotly")
    figure = render_plotly.to_plotly(signals_figure(made_up(), ["one", "two"], scale=EXPERIMENT.scale, page=True))
    lowest, highest = min(line.y.min() for line in figure.data), max(line.y.max() for line in figure.data)
    for axis in figure.select_yaxes():
        assert axis.range[0] < lowest < highest < axis.range[1]


class References(HTMLParser):
    """Everything that a browser would fetch, and the texts of scripts."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self.tags: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.found += [
            value or "" for name, value in attrs if name in ("src", "href", "srcset", "data", "action", "poster")
        ]


def test_a_page_holds_all_that_it_needs(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    references = References()
    references.feed(text)
    assert [one for one in references.found if not one.startswith("#")] == []
    assert not {"link", "img", "iframe", "base"} & set(references.tags)
    style = text[text.index("<style>") : text.index("</style>")]
    assert "url(" not in style
    assert "@import" not in style
    assert text.count("data:text/javascript;base64,") == 2  # three.js and its controls
    assert text.count('<figure class="view"') == 2  # frames, and the pack: not again for the recall without frames
    assert "plotly.js v" in text


def test_what_files_say_is_text_and_no_html(page: Path) -> None:
    assert HOSTILE not in page.read_text(encoding="utf-8")


def test_a_view_of_a_notebook_is_a_page_in_a_frame() -> None:
    shown = gm.view(PACK)._repr_html_()
    assert shown.startswith("<iframe srcdoc=")
    assert shown.count("<") == 2  # its own tags; all of the page is escaped


def test_the_command_writes_a_page_and_says_where(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    pytest.importorskip("plotly")
    assert gmem(monkeypatch, "report", PACK_FILE, "-o", tmp_path / "out.html", "--json") == 0
    said = json.loads(capsys.readouterr().out)
    assert said["sections"] == [f"Pack {PACK.name}"]
    assert (tmp_path / "out.html").stat().st_size < 2e6  # no figures, so no plotly


@pytest.mark.parametrize(
    ("content", "words"),
    [("{}", "it has no schema; a gradient or a tuned drive or a classification is needed"), ("[", "not JSON")],
)
def test_what_no_report_shows_is_refused_in_a_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path, content: str, words: str
) -> None:
    pytest.importorskip("plotly")
    (tmp_path / "what.json").write_text(content)
    assert gmem(monkeypatch, "report", tmp_path / "what.json", "-o", tmp_path / "out.html") == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out.html").exists()


def test_without_plotly_the_way_to_get_it_is_said(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "plotly.offline", None)
    assert gmem(monkeypatch, "report", PACK_FILE, "-o", tmp_path / "out.html") == 2
    assert "pip install '.[report]'" in capsys.readouterr().err


@pytest.fixture(scope="module")
def browser(page: Path) -> Iterator[Any]:
    """A headless Chromium that shows the page, without a network."""
    webdriver = pytest.importorskip("selenium.webdriver")
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if not chromium or not driver:
        pytest.skip("needs chromium and chromedriver")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    # A GPU is not needed: SwiftShader draws WebGL on the CPU.
    drawing = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--window-size=800,700"]
    alone = ["--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync"]
    for argument in ("--headless=new", "--no-sandbox", "--disable-quic", *drawing, *alone):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    with webdriver.Chrome(options=options, service=webdriver.ChromeService(driver)) as chrome:
        chrome.get(page.as_uri())
        chrome.execute_script("document.querySelector('.view').scrollIntoView()")
        begun = time.monotonic()
        while not chrome.execute_script("return !!document.querySelector('.view').view"):
            assert time.monotonic() - begun < 120.0, chrome.get_log("browser")
            time.sleep(0.05)
        yield chrome


PICTURE = """
const { canvas, renderer } = document.querySelector('.view').view, gl = renderer.getContext();
const pixels = new Uint8Array(4 * canvas.width * canvas.height);
gl.readPixels(0, 0, canvas.width, canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
let drawn = 0, sum = 0;
for (let at = 0; at < pixels.length; at += 4) {
  if (pixels[at] + pixels[at + 1] + pixels[at + 2] < 750) drawn += 1;
  sum = (31 * sum + pixels[at] + 7 * pixels[at + 1] + 13 * pixels[at + 2]) % 1000000007;
}
return [4 * drawn / pixels.length, sum];
"""
SET = """
const control = document.querySelector('.view .' + arguments[0]);
control.value = arguments[1];
control.dispatchEvent(new Event('input'));
return document.querySelector('.view .when').textContent;
"""


def test_a_browser_draws_it_all_and_fetches_nothing(browser: Any) -> None:
    assert browser.get_log("browser") == []
    assert browser.execute_script("return performance.getEntriesByType('resource').length") == 0
    assert browser.execute_script("return document.querySelectorAll('.plotly-graph-div .main-svg').length") > 0
    drawn, _ = browser.execute_script(PICTURE)
    assert 0.05 < drawn < 0.9  # of the picture: grains before a light background


def test_frames_are_opened_at_the_last(browser: Any) -> None:
    said = browser.execute_script("return document.querySelector('.view .when').textContent")
    assert said == "encode, u = 1.000, t = 300 t_c"


def test_the_controls_change_the_picture(browser: Any) -> None:
    pictures = {browser.execute_script(PICTURE)[1]}
    controls = (("frame", 2), ("colour", "coordination"), ("show", "both"), ("show", "forces"), ("cut", 0.5))
    for number, (control, value) in enumerate(controls, 2):
        said = browser.execute_script(SET, control, value)
        assert said != "encode, u = 1.000, t = 300 t_c"  # the last
        pictures.add(browser.execute_script(PICTURE)[1])
        assert len(pictures) == number, control
    assert browser.get_log("browser") == []
