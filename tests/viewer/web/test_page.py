"""Web page in a real Chromium: its numbers, its pictures and its controls."""

from __future__ import annotations

import base64
import hashlib
import io
import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from progdf.__main__ import main
from progdf.compose.layers import BLENDS, Gains, Layer
from progdf.compose.reference import compose_layers
from progdf.field.baked import GradeForm, SliderRemap, identity_map, lattice_colors
from progdf.field.grade import bake_grade
from progdf.formats.ply import save_ply
from progdf.gaussians import ATTRIBUTES, Gaussians, pack
from progdf.gdf.anchors import free_anchors
from progdf.gdf.file import Gdf, anchor_added, load_gdf, save_gdf
from progdf.rasterize import render
from progdf.region import from_mask
from progdf.scene.selection import project_centers
from progdf.similarity import affine_motion
from progdf.tidy import Step, leave_paint, mirror, similarity, tidy
from tests.helpers.draws import Draws
from tests.helpers.edits import curved_field, edit_of, growing, painted, rimmed, some_rows
from tests.helpers.scenes import random_gaussians
from tests.helpers.sessions import bear_files, full_view, saved_session
from tests.helpers.stacks import Stack, many_edits
from tests.helpers.ui_rig import bear
from viewer.camera.view_camera import ViewCamera, first_camera, to_camera
from viewer.files.document import Document
from viewer.files.web_page import PageOptions, write_page
from viewer.state import snapshots, timeline
from viewer.state.layers import visible_layers
from viewer.state.view_state import Keyframe, LayerGroup, LayerState, Timeline, ViewState
from viewer.web.page import PageTexts, join

SIZE = 660, 400
PIXELS = 330, 200  # half the resolution renders four times as fast in the software renderer


@dataclass
class Opened:
    """A page in its own tab, with its network requests and console messages."""

    tab: Any
    requests: list[str]
    complaints: list[str]

    def strengths(self) -> dict[str, float]:
        return self.tab.evaluate("Object.fromEntries(progdf.view.layers.map((l) => [l.name, l.strength]))")

    def wait(self, expression: str) -> None:
        """Wait until a JavaScript expression holds.

        Playwright's own wait compiles text in the page, which the page's content security policy forbids.
        """
        for _ in range(400):
            if self.tab.evaluate(expression):
                return
            self.tab.wait_for_timeout(25)
        raise AssertionError(f"{expression} never came; {self.complaints}")

    def camera(self) -> dict[str, Any]:
        return self.tab.evaluate("progdf.camera")

    def picture(self) -> np.ndarray:
        address = self.tab.evaluate("progdf.picture()")
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(address.split(",")[1]))).convert("RGB"))

    def slide(self, strengths: Sequence[float]) -> None:
        self.tab.evaluate(
            "(s) => progdf.change({...progdf.view,"
            " layers: progdf.view.layers.map((l, i) => ({...l, strength: s[i]}))})",
            list(strengths),
        )


@pytest.fixture
def open_page(browser: Any) -> Iterator[Any]:
    contexts = []

    def opening(path: Path, script: str = "", size: tuple[int, int] = SIZE, **options: Any) -> Opened:
        context = browser.new_context(viewport=dict(zip(("width", "height"), size, strict=True)), **options)
        contexts.append(context)
        tab = context.new_page()
        opened = Opened(tab, [], [])
        tab.on("request", lambda request: opened.requests.append(request.url))
        tab.on("pageerror", lambda error: opened.complaints.append(str(error)))
        tab.on("console", lambda message: opened.complaints.append(message.text))
        tab.add_init_script(f"Object.defineProperty(window, 'devicePixelRatio', {{value: 0.5}}); {script}")
        tab.goto(path.as_uri())
        return opened

    yield opening
    for context in contexts:
        context.close()


def ready(opened: Opened) -> Opened:
    opened.tab.wait_for_selector("body.drawn", timeout=20_000)
    return opened


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / max(np.mean((a.astype(float) - b) ** 2), 1e-12)))


def grade_form(members: int, degree: int, bands: int, seed: int) -> GradeForm:
    """Return a grade with a nonlinear color map, a residual, a mask and a slider remap."""
    draws = Draws(seed)
    knots = torch.tensor([0.0, 0.5, 1.0])
    same = identity_map(2) if degree else lattice_colors(5)
    bent = same + 0.3 * draws.normal(*same.shape)
    table = torch.stack([same, same + 0.4 * (bent - same), bent])
    if not degree:
        knots = knots[::2]
        table = table[::2]
    coefficients = torch.linspace(0, 1, len(knots))[:, None]
    residual = (draws.normal(1, members, 3 * bands) * 40).clamp(-127, 127).to(torch.int8)
    ends = (
        torch.tensor([0.0, 0.4, 1.0], dtype=torch.float64),
        torch.tensor([0.0, 0.6, 1.0], dtype=torch.float64),
    )
    mask = (255 * draws.uniform(members)).to(torch.uint8)
    scale = torch.full((1, 3 * bands), 0.004)
    return GradeForm(degree, knots, table, residual, scale, coefficients, SliderRemap(*ends), mask)


def graded(scene: Gaussians, name: str, degree: int, seed: int) -> Gdf:
    rows = some_rows(scene, 120, seed)
    form = grade_form(len(rows), degree, 1 + min(scene.shN.shape[1], 3), seed)
    return edit_of(scene, rows, bake_grade(form, pack(scene[rows], True)), name)


def leaving_paint(scene: Gaussians) -> Gdf:
    """Return an edit that moves Gaussians without their paint."""
    rows = some_rows(scene, 200, 8)
    edit = edit_of(scene, rows, curved_field(200, 8, 14 + 3 * len(scene.shN[0])), "leaves")
    return replace(edit, anchors=replace(free_anchors(0), leaves_paint=True))


def moves_of(scene: Gaussians) -> list[Gdf]:
    """Return moves that carry other edits: turned and scaled, mirrored, and stretched beside a removal."""
    half = from_mask("half", scene.means[:, 0] > 0)
    other = from_mask("other", scene.means[:, 1] > 0)
    stretch = affine_motion(torch.diag(torch.tensor([1.8, 1.0, 0.6])), torch.ones(3))
    turn = similarity((1.0, -2.0, 0.5), (0.3, -0.2, 0.9), 1.5)
    return [
        tidy(scene, [Step("transform", half, turn)], "turned"),
        tidy(scene, [Step("transform", other, mirror(1))], "mirrored"),
        leave_paint(tidy(scene, [Step("transform", half, stretch), Step("remove", other)], "stretched")),
        tidy(scene, [Step("transform", half, turn), Step("transform", other, stretch)], "two"),
    ]


def document_of(scene: Gaussians, gdfs: Sequence[Gdf]) -> tuple[Document, ViewState]:
    layers = tuple(LayerState(i, gdf.name) for i, gdf in enumerate(gdfs))
    return Document("scene.ply", scene, tuple(gdfs)), ViewState(camera=first_camera(scene), layers=layers)


def random_layer(gdf: Gdf, draws: Draws) -> Layer:
    gains = Gains(*draws.uniform(4).tolist()) if float(draws.uniform(1)) < 0.4 else Gains()
    weights = draws.uniform(gdf.members) if float(draws.uniform(1)) < 0.4 else None
    return Layer(gdf, float(draws.uniform(1)) * 1.5 - 0.3, gains=gains, weights=weights)


RUN = """([layers, blend]) => {
  const { composer } = progdf, top = layers.length - 1;  // its slider comes from elsewhere
  composer.update(layers.with(top, { ...layers[top], strength: 0.3 }), blend);
  composer.update(layers, blend);
  return Object.fromEntries([...composer.moving].map((name) => [name, [...composer.after[name]]]));
}"""


def page_order(opened: Opened, scene: Gaussians) -> np.ndarray:
    """Return the scene row of each row of an exact page. [N]"""
    means = np.asarray(opened.tab.evaluate("[...progdf.means]"), np.float32).reshape(-1, 3)
    rows = {row.tobytes(): i for i, row in enumerate(scene.means.numpy())}
    return np.array([rows[row.tobytes()] for row in means])


@pytest.mark.slow
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_page_computes_every_attribute_like_compose_for_every_rule(
    open_page: Any, tmp_path: Path, degree: int
) -> None:
    scene = random_gaussians(300, seed=5, sh_degree=degree)
    scene = replace(scene, logit_opacities=scene.logit_opacities.clamp(min=-4.0))  # none is pruned
    gdfs = [
        growing(scene, some_rows(scene, 40, 1), 25, 7),
        edit_of(scene, some_rows(scene, 150, 2), curved_field(150, 2, 14 + 3 * len(scene.shN[0])), "shirt"),
        graded(scene, "warm", 2, 3),
        graded(scene, "table", 0, 4),
        rimmed(painted(scene, 20, 9), 1),
        rimmed(painted(scene, 40, 12, "heart"), 2),
        anchor_added(growing(scene, some_rows(scene, 40, 6), 15, 6, "grown"), scene),
        leaving_paint(scene),
        *moves_of(scene),
    ]
    document, view = document_of(scene, gdfs)
    divided = tuple(replace(layer, gains=Gains(color=0.5)) for layer in view.layers)
    view = replace(view, layers=divided)  # so that the page has the textures
    write_page(tmp_path / "page.html", document, view, (), PageOptions(quality="exact"))
    opened = ready(open_page(tmp_path / "page.html"))
    assert opened.complaints == []
    order = page_order(opened, document.scene)
    place = np.empty(len(order), int)
    place[order] = np.arange(len(order))
    count = opened.tab.evaluate("progdf.composer.count")
    draws = Draws(degree)
    stacks: list[tuple[list[Layer], str]] = [
        ([Layer(g, s)], "adjust") for g in document.gdfs for s in (1.0, 0.0)
    ]
    stacks += [
        ([random_layer(document.gdfs[i], draws) for i in draws.order(len(gdfs)).tolist()], blend)
        for blend in BLENDS * 6
    ]
    for layers, blend in stacks[-len(BLENDS) * 2 :]:
        rules = ["", *BLENDS]
        own = [rules[int(5 * float(draws.uniform(1)))] for _ in layers]
        stacks.append(([replace(layer, blend=rule) for layer, rule in zip(layers, own, strict=True)], blend))
    stacks.append(([Layer(document.gdfs[1], 0.1), Layer(document.gdfs[2], 0.8)], "adjust"))  # few are black
    for number, (layers, blend) in enumerate(stacks):
        sent = []
        for layer in layers:
            edit = next(i for i, gdf in enumerate(document.gdfs) if gdf is layer.gdf)
            at = np.argsort(place[layer.gdf.region.members.numpy()])
            weights = None if layer.weights is None else layer.weights.numpy()[at].tolist()
            sent.append(
                {
                    "edit": edit,
                    "strength": layer.strength,
                    "gains": asdict(layer.gains),
                    "blend": layer.blend,
                    "weights": weights,
                    "paint": number,
                }
            )
        after = opened.tab.evaluate(RUN, [sent, blend])
        plain = compose_layers(document.scene, layers, blend)
        for name in ATTRIBUTES:
            if name not in after:
                continue
            numbers = getattr(plain, name)[torch.from_numpy(order[:count])].numpy()
            page = np.asarray(after[name], np.float32).reshape(numbers.shape)
            if number < 2 * len(gdfs):  # one layer at an endpoint
                assert page.tobytes() == numbers.tobytes(), (name, number)
            else:
                # axes of stretched, nearly round Gaussians depend on the last bits
                error = 1e-5 if name == "quats" else 1e-6
                assert np.abs(page - numbers).max() <= error * max(1.0, np.abs(numbers).max()), (name, blend)


@pytest.fixture(scope="module")
def bear_page(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Stack]:
    """Export the bear with scarf and ears at strength 0.5; return the page and the stack."""
    folder = tmp_path_factory.mktemp("bear")
    scene, *edits = bear().save(folder)
    half = [word for gdf in bear().gdfs for word in ("--set", f"{gdf.name}=0.5")]
    out = folder / "page.html"
    assert main(["export", str(scene), *map(str, edits), "-o", str(out), "--quality", "exact", *half]) == 0
    return out, bear()


def seen_camera(scene: Gaussians, camera: dict[str, Any]) -> ViewCamera:
    """Return a page's camera as a camera of the window."""
    values = {name: tuple(v) if isinstance(v, list) else v for name, v in camera.items()}
    return replace(first_camera(scene), **values)


def cpu_picture(stack: Stack, camera: dict[str, Any], strengths: Sequence[float]) -> np.ndarray:
    """Render with the CPU engine from the page's camera. [H,W,3] uint8"""
    seen = seen_camera(stack.scene, camera)
    layers = [Layer(gdf, s) for gdf, s in zip(stack.gdfs, strengths, strict=True)]
    with torch.no_grad():
        edited = compose_layers(stack.scene, layers, "adjust")
        image = render(edited, to_camera(seen, *PIXELS), background=(1.0, 1.0, 1.0)).image
    return (image.clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy()


@pytest.mark.parametrize(("quality", "least"), [("exact", 60.0), ("compact", 50.0)])
def test_page_pictures_match_the_cpu_engine(
    open_page: Any, tmp_path: Path, quality: str, least: float
) -> None:
    stack = bear()
    document, view = document_of(stack.scene, stack.gdfs)
    write_page(tmp_path / "page.html", document, view, (), PageOptions(quality=quality))  # type: ignore[arg-type]
    opened = ready(open_page(tmp_path / "page.html"))
    opened.tab.click("#fold")
    for strengths in ((0.0, 0.0), (1.0, 1.0), (0.3, 0.8)):
        opened.slide(strengths)
        picture = opened.picture()
        assert picture.shape == (*PIXELS[::-1], 3)
        assert psnr(picture, cpu_picture(stack, opened.camera(), strengths)) >= least


@pytest.mark.slow
def test_mouse_orbits_pans_zooms_and_sets_the_pivot(open_page: Any, bear_page: tuple[Path, Stack]) -> None:
    opened = ready(open_page(bear_page[0]))
    mouse = opened.tab.mouse
    start = opened.camera()
    mouse.move(100, 150)
    mouse.down()
    mouse.move(160, 170, steps=3)
    mouse.up()
    turned = opened.camera()
    assert turned["azimuth"] == pytest.approx((start["azimuth"] - 18 + 180) % 360 - 180)
    assert turned["elevation"] == pytest.approx(start["elevation"] + 6)
    mouse.down(button="right")
    mouse.move(150, 170, steps=3)
    mouse.up(button="right")
    assert opened.camera()["pivot"] != turned["pivot"]
    mouse.wheel(0, -100)
    opened.wait(f"progdf.camera.distance < {0.95 * turned['distance']}")
    opened.tab.click("#fold")
    opened.tab.click("#home")
    opened.wait("!progdf.glide")
    assert opened.camera() == start
    before = opened.tab.evaluate("progdf.camera.pivot")
    mouse.dblclick(SIZE[0] / 2, SIZE[1] / 2)
    opened.wait(f"!progdf.glide && progdf.camera.pivot[0] !== {before[0]}")
    pivot = np.array(opened.camera()["pivot"])
    scene = bear_page[1].scene
    assert np.abs(pivot - before).max() > 1e-3
    # the pivot is as close to a Gaussian as neighbors on the bear's surface are
    assert float((scene.means - torch.tensor(pivot)).norm(dim=1).min()) < 0.1


def test_slider_moves_by_mouse_and_keys_and_shows_recordings(
    open_page: Any, bear_page: tuple[Path, Stack]
) -> None:
    page, stack = bear_page
    opened = ready(open_page(page))
    names = opened.tab.locator(".layer .name").all_text_contents()
    assert names == [gdf.name for gdf in reversed(stack.gdfs)], "the top layer first"
    inner = [s for s in stack.gdfs[0].field.recorded if 0 < s < 1]
    assert opened.tab.locator(".layer").last.locator(".ticks i").count() == len(inner) > 0
    slider = opened.tab.get_by_role("slider", name="scarf")
    box = slider.bounding_box()
    opened.tab.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    opened.tab.mouse.down()
    opened.tab.mouse.move(box["x"] + box["width"] + 30, box["y"] + 10, steps=4)
    opened.tab.mouse.up()
    assert opened.strengths()["scarf"] == 1.0
    for _ in range(3):
        opened.tab.keyboard.press("ArrowLeft")
    assert opened.strengths() == {"scarf": pytest.approx(0.97), "ears": 0.5}
    assert opened.tab.locator(".layer").last.locator("output").text_content() == "97"


def test_page_starts_with_the_session_blend_rule_and_can_change_it(open_page: Any, tmp_path: Path) -> None:
    scene = random_gaussians(300, seed=5)
    scene = replace(scene, logit_opacities=scene.logit_opacities.clamp(min=-4.0))  # none is pruned
    gdfs = [
        edit_of(scene, some_rows(scene, 150, i), curved_field(150, i, 14), name)
        for i, name in enumerate("ab")
    ]
    document, view = document_of(scene, gdfs)
    view = replace(view, blend="over")
    write_page(tmp_path / "page.html", document, view, (), PageOptions(quality="exact"))
    opened = ready(open_page(tmp_path / "page.html"))
    order = page_order(opened, scene)
    choice = opened.tab.get_by_label("Blend rule")
    opened.slide([0.8, 0.8])
    opened.picture()
    choice.focus()
    for key, text, rule in (
        ("", "Over", "over"),
        ("ArrowUp", "Add", "sum"),
        ("ArrowUp", "Average", "normalized"),
        ("End", "Adjust", "adjust"),
    ):
        if key:
            opened.tab.keyboard.press(key)
        opened.wait(f"progdf.composer.blend === '{rule}'")
        assert choice.locator("option:checked").inner_text() == text
        colors = np.array(opened.tab.evaluate("[...progdf.composer.after.sh0]"), np.float32).reshape(-1, 3)
        plain = compose_layers(scene, [Layer(gdf, 0.8) for gdf in gdfs], rule).sh0[order[: len(colors)]]
        assert np.abs(colors - plain.numpy()).max() < 1e-5, text
    assert opened.complaints == []


def test_panel_follows_the_background() -> None:
    still = torch.zeros(2, 2, 3)
    shades = [PageTexts("bear", "", (gray,) * 3, still).shade for gray in (0.0, 0.4, 0.6, 1.0)]
    assert shades == ["dark", "dark", "light", "light"]


def test_space_shows_the_original_while_held(open_page: Any, bear_page: tuple[Path, Stack]) -> None:
    opened = ready(open_page(bear_page[0]))
    edited = opened.picture()
    opened.tab.keyboard.down(" ")
    held = opened.picture()
    opened.tab.keyboard.up(" ")
    opened.slide((0.0, 0.0))
    assert psnr(held, opened.picture()) > 90 > psnr(held, edited)
    opened.slide((0.5, 0.5))
    assert psnr(opened.picture(), edited) > 90
    opened.tab.get_by_label("Hide ears").click()
    assert opened.tab.evaluate("progdf.view.layers.map((l) => l.enabled)") == [True, False]


def test_page_makes_no_requests_and_logs_no_errors(open_page: Any, bear_page: tuple[Path, Stack]) -> None:
    opened = ready(open_page(bear_page[0]))
    assert opened.complaints == []
    opened.tab.evaluate("fetch('https://example.org/').catch((e) => 0)")
    assert [url for url in opened.requests if not url.startswith(("file:", "blob:", "data:"))] == []
    assert "Content Security Policy" in opened.complaints[0], "nor can anything that a name might bring in"


def test_two_fingers_pan_and_zoom_on_a_phone(open_page: Any, bear_page: tuple[Path, Stack]) -> None:
    opened = ready(open_page(bear_page[0], size=(300, 400), has_touch=True, is_mobile=True))
    session = opened.tab.context.new_cdp_session(opened.tab)

    def touch(kind: str, *points: tuple[int, int]) -> None:
        at = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(points)]
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": at})

    start = opened.camera()
    touch("touchStart", (100, 60))
    touch("touchMove", (130, 60))
    touch("touchEnd")
    assert opened.camera()["azimuth"] != start["azimuth"]
    assert opened.camera()["distance"] == start["distance"]
    touch("touchStart", (100, 60), (140, 60))
    touch("touchMove", (90, 70), (170, 70))
    touch("touchEnd")
    assert opened.camera()["distance"] == pytest.approx(start["distance"] / 2, rel=0.05)
    assert opened.camera()["pivot"] != start["pivot"]
    panel = opened.tab.locator("#panel").bounding_box()
    assert (panel["x"], panel["width"]) == (0, 300), "along the lower edge"


SHARES = """
window.shares = [];
window.onprogdf = (page) => {
  const draw = page.renderer.draw.bind(page.renderer);
  page.renderer.draw = (at, background, share) => { shares.push(share); draw(at, background, share); };
};
Object.defineProperty(window, 'progdf', {
  set(page) { this.shown = page; if (page) onprogdf(page); }, get() { return this.shown; },
});
"""
"""Script that records the share of the width and height of each frame."""


def test_first_picture_has_few_pixels_and_the_still_stays_until_the_sharp_one(
    open_page: Any, bear_page: tuple[Path, Stack]
) -> None:
    opened = ready(open_page(bear_page[0], SHARES))
    marks = opened.tab.evaluate("performance.getEntriesByType('mark').map((mark) => mark.name)")
    assert marks == ["first picture", "sharp picture"]
    # a frame is drawn again if the page's size comes late
    shares = [share for share, _ in groupby(opened.tab.evaluate("shares"))]
    assert shares == [0.25, 1]


@pytest.mark.parametrize("size", [(660, 400), (390, 720)], ids=["beside the panel", "phone"])
def test_exported_page_shows_a_wide_subject_whole(
    open_page: Any, tmp_path: Path, size: tuple[int, int]
) -> None:
    scene = random_gaussians(400)
    wide = replace(scene, means=scene.means * torch.tensor([4.0, 1.0, 1.0]))
    save_ply(tmp_path / "wide.ply", wide)
    assert main(["export", str(tmp_path / "wide.ply"), "-o", str(tmp_path / "wide.html"), "--up", "+y"]) == 0
    opened = ready(open_page(tmp_path / "wide.html", size=size))
    panel = opened.tab.locator("#panel").bounding_box()
    free = (panel["x"], size[1]) if panel["x"] else (size[0], panel["y"])
    side = round(min(free))
    centers = project_centers(wide, to_camera(seen_camera(wide, opened.camera()), side, side))
    x = centers.points[:, 0] + (free[0] - side) / 2
    assert np.mean((x > 0) & (x < free[0])) > 0.95  # all but strays


@pytest.mark.parametrize(
    "size", [(660, 400), (900, 400), (390, 720)], ids=["narrow", "wide", "phone with a panel below"]
)
def test_picture_replaces_the_still_without_a_jump(
    open_page: Any, bear_page: tuple[Path, Stack], size: tuple[int, int]
) -> None:
    """The still fills the area beside the panel, and nothing in it moves when the picture is ready."""
    opened = ready(open_page(bear_page[0], size=size))
    opened.wait("document.body.classList.contains('sharp')")
    panel = opened.tab.locator("#panel").bounding_box()
    free = (panel["x"], size[1]) if panel["x"] else (size[0], panel["y"])
    clip = {"x": 0, "y": 0, "width": free[0], "height": free[1]}
    drawn, still = (_screenshot(opened, clip, shown) for shown in (True, False))
    assert psnr(drawn, still) > 22.0


def _screenshot(opened: Opened, clip: dict[str, float], drawn: bool) -> np.ndarray:
    """Return a part of the page, with the picture or with the still. [H,W,3]"""
    opened.tab.evaluate(f"document.body.classList.toggle('drawn', {str(drawn).lower()})")
    picture = opened.tab.screenshot(clip=clip)
    return np.asarray(Image.open(io.BytesIO(picture)).convert("RGB"))


@pytest.mark.parametrize(
    ("sharp_ms", "coarse_ms", "share"),
    [
        (20, 15, 1),
        (400, 40, 0.25),
        (4000, 65, 0.125),
        (400, 390, 1),
    ],
)
def test_frames_in_motion_have_as_many_pixels_as_the_device_draws_in_time(
    open_page: Any, bear_page: tuple[Path, Stack], sharp_ms: int, coarse_ms: int, share: float
) -> None:
    """The last case is limited by the number of Gaussians, which fewer pixels do not reduce."""
    opened = ready(open_page(bear_page[0], SHARES))
    opened.tab.evaluate(
        f"shares.length = 0; progdf.times = {{sharp: {sharp_ms}, coarse: {coarse_ms}}};"
        "progdf.look({...progdf.camera, azimuth: progdf.camera.azimuth + 1})"
    )
    opened.wait("shares.length > 0")
    assert opened.tab.evaluate("shares[0]") == share
    opened.wait("shares.at(-1) === 1")


NO_WEBGL = "HTMLCanvasElement.prototype.getContext = () => null"


def test_page_without_webgl_shows_a_still_and_a_message(
    open_page: Any, bear_page: tuple[Path, Stack]
) -> None:
    opened = open_page(bear_page[0], NO_WEBGL)
    opened.wait("document.getElementById('notice').textContent.includes('WebGL2')")
    assert opened.tab.evaluate("document.getElementById('still').naturalWidth") == 1680
    assert opened.tab.locator("#still").is_visible()
    assert not opened.tab.locator("#controls").is_visible()
    assert opened.complaints == []


def test_page_keeps_only_the_values_of_members_in_memory(open_page: Any, tmp_path: Path) -> None:
    scene = random_gaussians(10_000, seed=6, sh_degree=3)
    members = torch.arange(2500)
    document, view = document_of(scene, [edit_of(scene, members, curved_field(2500, 1, 59), "shirt")])
    write_page(tmp_path / "page.html", document, view, (), PageOptions(quality="exact"))
    opened = ready(open_page(tmp_path / "page.html"))
    opened.wait("progdf.renderer.drawn > 0")
    session = opened.tab.context.new_cdp_session(opened.tab)
    session.send("HeapProfiler.collectGarbage")
    used = session.send("Runtime.getHeapUsage")["backingStorageSize"]
    before = 2 * 2500 * 59 * 4  # the members before and after the edit
    levels = 2500 * 59 * (4 + 2)  # the edit's end and bases
    assert used < before + levels + 2.5e6, "what came is 2.4 MB more"


@pytest.mark.slow
def test_large_scene_is_sorted_by_a_worker_if_the_policy_allows_it(
    open_page: Any, bear_page: tuple[Path, Stack], tmp_path: Path
) -> None:
    page = bear_page[0].read_text()
    large = page.replace("LARGE = 150_000", "LARGE = 10")
    assert large != page
    digest = base64.b64encode(
        hashlib.sha256(re.findall(r"<script>(.*?)</script>", large, re.S)[0].encode()).digest()
    )
    large = re.sub(r"script-src 'sha256-[^']+'", f"script-src 'sha256-{digest.decode()}'", large)
    (tmp_path / "worker.html").write_text(large)
    (tmp_path / "strict.html").write_text(large.replace("worker-src blob:", "worker-src 'none'"))
    plain = ready(open_page(bear_page[0])).picture()
    for name, works in (("worker", True), ("strict", False)):
        opened = ready(open_page(tmp_path / f"{name}.html"))
        opened.wait("progdf.renderer.drawn > 0")
        assert opened.tab.evaluate("progdf.sorter.worker !== null") == works
        assert psnr(opened.picture(), plain) > 90


HOSTILE = "</script><script>document.title='run'</script><img src=x onerror=\"document.title='run'\">&lt;"


def test_untrusted_names_and_texts_are_never_run_as_html(open_page: Any, tmp_path: Path) -> None:
    stack = bear()
    scene, *paths = stack.save(tmp_path)
    names = (HOSTILE, "x" * 10_000)
    for path, name in zip(paths, names, strict=True):
        save_gdf(path, replace(load_gdf(path, stack.scene), name=name))
    out = tmp_path / "page.html"
    texts = ["--title", HOSTILE, "--credit", HOSTILE + " https://example.org/?a=1&b=%22<b>"]
    assert main(["export", str(scene), *map(str, paths), "-o", str(out), *texts]) == 0
    opened = ready(open_page(out))
    assert opened.complaints == []
    assert opened.tab.title() == HOSTILE
    assert opened.tab.locator("h1").text_content() == HOSTILE
    shown = opened.tab.locator(".layer .name").all_text_contents()
    assert shown == ["x" * 10_000, HOSTILE]
    assert opened.tab.locator("footer a").get_attribute("href") == "https://example.org/?a=1&b=%22"
    assert opened.tab.locator("#panel").bounding_box()["width"] == 312, "a long name widens nothing"
    assert opened.tab.evaluate("document.querySelectorAll('script, img').length") == 3


@pytest.fixture(scope="module")
def session_page(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    session = saved_session(bear_files(tmp_path_factory.mktemp("session")))
    out = session.with_name("page.html")
    assert main(["export", str(session), "-o", str(out), "--title", "work"]) == 0
    return session, out


def test_session_page_has_its_camera_groups_snapshots_and_film(
    open_page: Any, session_page: tuple[Path, Path]
) -> None:
    saved = json.loads(session_page[0].read_text())["view"]
    opened = ready(open_page(session_page[1]))
    camera = opened.camera()
    assert all(
        camera[name] == pytest.approx(saved["camera"][name])
        for name in ("azimuth", "distance", "up", "fov_y")
    )
    assert opened.tab.evaluate("progdf.header.background") == pytest.approx(saved["background"])
    assert opened.tab.evaluate("progdf.view.blend") == saved["blend"] == "over"
    assert opened.strengths() == {"ears → gold": 0.75, "scarf": 0.25}
    assert opened.tab.get_by_role("slider", name="warm").input_value() == "0.5"
    opened.tab.get_by_role("slider", name="warm").press("ArrowRight")
    assert opened.tab.evaluate("progdf.view.groups[0].strength") == pytest.approx(0.51)
    painted = opened.tab.evaluate("progdf.composer.edits.length && [...progdf.paints[0]]")
    assert (min(painted), max(painted), len(painted)) == (0.0, 1.0, len(bear().gdfs[1].region))
    opened.tab.get_by_role("button", name="original", exact=True).click()
    assert set(opened.strengths().values()) == {0.0}
    opened.tab.get_by_role("button", name="1", exact=True).click()
    assert opened.strengths() == {"ears → gold": 0.75, "scarf": 0.25}
    assert opened.tab.evaluate("progdf.view.blend") == "sum"
    chips = "[...progdf.root.querySelectorAll('.chip')].map((chip) => chip.classList.contains('on'))"
    assert opened.tab.evaluate(chips) == [False, True], "it shows which"
    opened.tab.get_by_role("button", name="Play").click()
    opened.wait("progdf.frame > 3")
    assert opened.strengths()["scarf"] == 0.5, "the key's"


def in_page(opened: Opened, expression: str, *values: Any) -> Any:
    """Evaluate an expression with functions of the page; `values` are bound to a, b, c and so on."""
    names = "abcdef"[: len(values)]
    body = join(("camera", "state"), f"return {expression};").removesuffix(";\n")
    return opened.tab.evaluate(f"([{','.join(names)}]) => {body}", list(values))


def test_film_on_the_page_matches_the_window(open_page: Any, tmp_path: Path) -> None:
    draws = Draws(3)
    view = full_view()
    keys = tuple(
        Keyframe(
            frame,
            ((0, float(draws.uniform(1))), (1, float(draws.uniform(1)))),
            replace(
                view.camera, azimuth=azimuth, elevation=20 * frame / 7, distance=1 + float(draws.uniform(1))
            ),
            easing,
        )
        for frame, azimuth, easing in (
            (0, 170.0, "smooth"),
            (7, -150.0, "smooth"),
            (12, 20.0, "linear"),
            (20, 9.0, "hold"),
        )
    )
    document = Document("scene.ply", bear().scene, bear().gdfs)
    write_page(tmp_path / "page.html", document, replace(view, timeline=Timeline(keys, 24)))
    opened = ready(open_page(tmp_path / "page.html"))
    for frame in (0, 2, 7, 11, 20, 24):
        opened.tab.evaluate(f"progdf.seek({frame})")
        plain = timeline.state_at(Timeline(keys, 24), frame, view)
        camera = opened.camera()
        for name in ("azimuth", "elevation", "distance", "fov_y", "pivot", "up"):
            assert camera[name] == pytest.approx(getattr(plain.camera, name), abs=1e-9), (frame, name)
        assert opened.strengths() == pytest.approx({layer.name: layer.strength for layer in plain.layers})


def test_snapshot_on_the_page_matches_the_window(open_page: Any, tmp_path: Path) -> None:
    stack, view = many_edits(bear(), 4)
    draws = Draws(8)
    kept = ()
    for _ in range(6):
        alone, off, master = draws.uniform(3).tolist()
        layers = tuple(
            replace(
                view.layers[i],
                strength=round(float(draws.uniform(1)), 3),
                enabled=float(draws.uniform(1)) < 0.7,
                solo=alone < 0.4 and i == 3,
                gains=Gains(*draws.uniform(4).tolist()),
                group="pair" if i in (1, 3) else "",
            )
            for i in draws.order(4).tolist()
        )
        kept = snapshots.take(
            kept, replace(view, layers=layers, groups=(LayerGroup("pair", off < 0.7, master),))
        )
    view = snapshots.restore(view, kept[-1])
    document = Document("scene.ply", stack.scene, stack.gdfs)
    write_page(tmp_path / "page.html", document, view, kept)
    opened = ready(open_page(tmp_path / "page.html"))
    listed = snapshots.with_original(kept, view)
    known = opened.tab.evaluate("[progdf.view, progdf.snapshots]")
    for number, each in enumerate(listed):
        page = in_page(opened, "visibleLayers(restore(a, b[c]))", *known, number)
        plain = visible_layers(snapshots.restore(view, each))
        assert [layer["edit"] for layer in page] == [layer.gdf for layer in plain], number
        for mine, theirs in zip(page, plain, strict=True):
            assert mine["strength"] == pytest.approx(theirs.strength), number
            assert mine["gains"] == pytest.approx(asdict(theirs.gains))


def test_export_reports_page_size_and_the_cost_of_fewer_sh_bands(tmp_path: Path) -> None:
    document, view = document_of(bear(600).scene, bear(600).gdfs)
    out = tmp_path / "page.html"

    def written(**options: Any) -> tuple[int, str]:
        line = write_page(out, document, view, (), PageOptions(**options))
        return out.stat().st_size, line

    size, _ = written()
    assert size < written(quality="exact")[0]
    assert size > written(layers="scarf")[0], "an edit that is at 0 and has no slider is left out"
    smaller, line = written(sh=0)
    assert smaller < size
    assert re.search(rf"{smaller / 1e6:.2f} MB, compact, SH degree 0 of 1, \d\d\.\d dB to the scene", line), (
        line
    )


def test_failed_page_export_is_one_line_and_keeps_the_old_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene, *edits = map(str, bear().save(tmp_path))
    out = tmp_path / "page.html"
    out.write_text("earlier")
    (tmp_path / "broken.session.json").write_text('{"view": [1, ')
    bad: list[tuple[list[str], str]] = [
        ([scene, *edits, "--layers", "hat"], "no layer of that name; the layers are ears, scarf"),
        ([scene, "-o", str(tmp_path / "page.ply"), "--title", "x"], "not a web page"),
        ([str(tmp_path / "broken.session.json")], "broken.session.json"),
    ]
    for words, message in bad:
        assert main(["export", *words, *([] if "-o" in words else ["-o", str(out)])]) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1
    assert out.read_text() == "earlier"
