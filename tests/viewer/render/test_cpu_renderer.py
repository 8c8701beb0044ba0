"""CPU renderer: pictures prepared ahead, sequences of slider changes, and the picture on screen."""

from __future__ import annotations

import math
from dataclasses import replace

import moderngl
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from progdf.camera import Camera
from progdf.demo_scenes import bear
from progdf.field.baked import AttributeBases, BakedField
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf, fingerprint
from progdf.metrics.image import psnr
from progdf.rasterize import ActivatedGaussians
from progdf.rasterize.cpu.pyramid import Pyramid
from progdf.region import Region
from tests.helpers.stacks import Stack
from viewer.camera.view_camera import first_camera, to_camera
from viewer.gl.present import read_rgb
from viewer.render import cpu_renderer as cpu_renderer
from viewer.render import dynamic_resolution
from viewer.render.cpu_renderer import CpuRenderer
from viewer.render.engine import ViewEngine
from viewer.render.highlight import Highlight
from viewer.state.selection import pack
from viewer.state.view_state import LayerState, ViewState

SIZE = (160, 120)


def view_of(stack: Stack, *strengths: float) -> ViewState:
    layers = tuple(LayerState(i, str(i), strength) for i, strength in enumerate(strengths))
    return ViewState(camera=first_camera(stack.scene, stack.demo.cameras), layers=layers)


def wandering(scene: Gaussians) -> Gdf:
    """Return an edit that moves members across and out of the picture and behind the camera.

    The members also grow very large, become transparent and return.
    """
    rng = torch.Generator().manual_seed(5)
    members = torch.randperm(len(scene), generator=rng)[:60].sort().values
    nodes = torch.tensor([0.0, 0.5, 1.0])

    def base(full: torch.Tensor) -> AttributeBases:
        none = torch.zeros(0, *full.shape, dtype=torch.int8)
        return AttributeBases(full, none, torch.ones(1, full.shape[1]), nodes[:, None].clone())

    def noise(width: int, size: float) -> torch.Tensor:
        return size * torch.randn(len(members), width, generator=rng)

    attributes = {
        "means": base(noise(3, 3.0)),
        "quats": base(noise(4, 1.0)),
        "log_scales": base(noise(3, 1.0)),
        "logit_opacities": base(noise(1, 6.0)),
    }
    score = torch.zeros(len(scene)).index_fill(0, members, 1.0)
    field = BakedField("separable", nodes, attributes, 14)
    return Gdf("wandering", Region("wandering", members, score), field, fingerprint(scene))


def test_prepared_picture_is_drawn_unless_the_view_changed(stack: Stack) -> None:
    engine, afresh = (ViewEngine(None, stack.scene, stack.gdfs) for _ in range(2))
    views = [view_of(stack, strength) for strength in (0.2, 0.9)]
    for begun in views:
        camera = to_camera(begun.camera, *SIZE)
        engine.image(begun, (SIZE[0] // 2, SIZE[1] // 2))
        while not engine.prepare(begun, camera):
            pass
        for shown in (begun, *views):
            np.testing.assert_array_equal(engine.image(shown, SIZE), afresh.image(shown, SIZE))
            moved = camera.viewmat + 0.01 * torch.eye(4)[:, 2:3] @ torch.eye(4)[3:]  # never drawn
            engine.prepare(shown, replace(camera, viewmat=moved))


def test_random_slider_sequence_equals_full_renders_bit_for_bit(stack: Stack) -> None:
    edits = (*stack.gdfs, wandering(stack.scene))
    kept = ViewEngine(None, stack.scene, edits)
    rng = np.random.default_rng(3)
    view = view_of(stack, 0.0, 0.0, 0.0)
    for step in range(60):
        which = int(rng.integers(3))
        layers = list(view.layers)
        layers[which] = replace(layers[which], strength=float(rng.choice([0.0, 1.0, rng.random()])))
        view = replace(view, layers=tuple(layers))
        if step % 15 == 14:
            view = replace(view, camera=replace(view.camera, azimuth=view.camera.azimuth + 30.0))
        if step % 20 == 19:
            view = replace(view, blend="sum" if view.blend == "normalized" else "normalized")
        image = kept.image(view, SIZE)
        fresh = ViewEngine(None, kept.gaussians(view))
        assert np.array_equal(image, fresh.image(replace(view, layers=()), SIZE)), step


def _camera(view: ViewState) -> Camera:
    return to_camera(view.camera, *SIZE)


def test_returned_picture_is_never_overwritten(stack: Stack) -> None:
    engine = ViewEngine(None, stack.scene, stack.gdfs)
    engine.image(view_of(stack, 0.1), SIZE)
    image = engine.image(view_of(stack, 0.4), SIZE)
    before = image.copy()
    again = engine.image(view_of(stack, 0.9), SIZE)
    assert np.array_equal(image, before)
    assert not np.array_equal(again, before)


def test_several_changes_before_a_picture_are_all_drawn(stack: Stack) -> None:
    engine = ViewEngine(None, stack.scene, stack.gdfs)
    engine.image(view_of(stack, 0.5, 0.5), SIZE)
    engine.gaussians(view_of(stack, 0.9, 0.5))  # composes without drawing
    view = view_of(stack, 0.9, 0.1)
    fresh = ViewEngine(None, stack.scene, stack.gdfs)
    assert np.array_equal(engine.image(view, SIZE), fresh.image(view, SIZE))


@pytest.mark.gl
def test_screen_shows_the_last_picture(ctx: moderngl.Context, stack: Stack) -> None:
    screen = ctx.framebuffer([ctx.texture(SIZE, 4)])
    engine, fresh = (ViewEngine(ctx, stack.scene, stack.gdfs, draw="cpu") for _ in range(2))
    for scarf, ears in ((0.0, 0.0), (0.5, 0.0), (1.0, 0.3), (1.0, 0.9), (0.0, 0.9)):
        engine.image(view_of(stack, scarf, 0.5 * ears), SIZE)  # this picture never reaches the screen
        engine.draw(view_of(stack, scarf, ears), screen, SIZE)
        shown = read_rgb(screen, SIZE)
        image = np.round(np.clip(fresh.image(view_of(stack, scarf, ears), SIZE), 0.0, 1.0) * 255.0)
        assert np.abs(shown.astype(int) - image).max() <= 1
    for held in (engine, fresh, screen):
        held.release()


@pytest.mark.parametrize("draw", ["cpu", "gl"])
def test_moving_picture_follows_sliders_and_highlights(
    ctx: moderngl.Context, stack: Stack, monkeypatch: pytest.MonkeyPatch, draw: str
) -> None:
    monkeypatch.setattr(dynamic_resolution, "BUDGETS", (len(stack.scene),) * 3)
    monkeypatch.setattr(dynamic_resolution, "ERROR_LIMITS_PX2", (1e-3, 1e-3))
    slid, afresh = (ViewEngine(ctx, stack.scene, stack.gdfs, draw) for _ in range(2))
    framebuffer = ctx.simple_framebuffer(SIZE)

    def moving(engine: ViewEngine, view: ViewState) -> NDArray[np.float32]:
        engine.draw(replace(view, background=(0.0, 0.0, 0.0)), framebuffer, SIZE, pixels=2)
        dynamic_resolution._worker().submit(int).result()  # the pyramid is finished now
        engine.draw(view, framebuffer, SIZE, pixels=2)
        return engine.renderer.pixels()

    before = moving(slid, view_of(stack, 0.0, 0.1))
    hidden = torch.zeros(len(stack.scene), dtype=torch.bool)
    hidden[::7] = True
    target = view_of(stack, 0.9, 0.6)
    target = replace(target, selection=replace(target.selection, hidden=pack(hidden.numpy())))
    slid.highlight = afresh.highlight = Highlight(region=1)
    slid.image(view_of(stack, 0.3, 0.6), SIZE)  # a full picture, so the pyramid falls behind
    after = moving(slid, target)
    expected = moving(afresh, target)
    assert float(np.abs(after - before).mean()) > 1e-2
    assert psnr(torch.from_numpy(after), torch.from_numpy(expected)) > 45.0
    live = slid.renderer._scene if isinstance(slid.renderer, CpuRenderer) else slid.renderer._moving[0]
    pyramid = live._pyramid.result()
    merged = [array.copy() for array in pyramid.nodes[:2]]
    pyramid.refresh(np.arange(len(stack.scene)), colors_only=False)
    assert all(map(np.array_equal, merged, pyramid.nodes[:2])), "nothing was behind"
    for engine in (slid, afresh):
        engine.release()


def test_moving_picture_is_refined_only_if_drawing_is_quick(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene = bear(6000).gaussians
    live = dynamic_resolution.LiveScene(scene)
    camera = to_camera(first_camera(scene), *SIZE)
    pyramid = live.begin_pyramid().result()
    monkeypatch.setattr(dynamic_resolution, "FINE_MS", (0.0, 0.0))
    slow = [live.draw_fewer(lambda fewer: len(fewer.means), camera, 2) for _ in range(3)]
    assert pyramid.limit == dynamic_resolution.ERROR_LIMITS_PX2[1]
    monkeypatch.setattr(dynamic_resolution, "FINE_MS", (1e9, 1e9))
    quick = [live.draw_fewer(lambda fewer: len(fewer.means), camera, 2) for _ in range(30)]
    assert pyramid.limit == dynamic_resolution.ERROR_LIMITS_PX2[0]
    assert slow[0] == slow[2] == quick[0] < quick[1] < quick[29], "the time has changed, not the view"


def test_small_picture_does_not_affect_the_full_one(stack: Stack) -> None:
    engine, afresh = (ViewEngine(None, stack.scene, stack.gdfs) for _ in range(2))
    engine.image(view_of(stack, 0.1, 0.6), SIZE, pixels=2)
    dynamic_resolution._worker().submit(int).result()  # the pyramid is finished now
    small = engine.image(view_of(stack, 0.4, 0.6), SIZE, pixels=2).copy()
    full = engine.image(view_of(stack, 0.4, 0.6), SIZE)
    assert not np.array_equal(full, small)
    assert np.array_equal(full, afresh.image(view_of(stack, 0.4, 0.6), SIZE))


def test_allowed_detail_is_measured_from_full_pictures() -> None:
    scene = bear(6000).gaussians
    live, camera = dynamic_resolution.LiveScene(scene), to_camera(first_camera(scene), *SIZE)
    full = np.full((SIZE[1], SIZE[0], 3), 0.5, np.float32)

    def measure(share: float) -> None:
        """Compare pictures whose error is `share` times the allowed error."""
        error = np.float32(math.sqrt(share * dynamic_resolution.FINE_ERROR))
        live.measure(full[::2, ::2] + error, full)

    measure(10.0)
    assert live._max_finest == dynamic_resolution.ERROR_LIMITS_PX2[1], "there is no pyramid yet"
    live.begin_pyramid().result()
    live.draw_fewer(lambda fewer: None, camera, 2)
    for share in (8.0, 0.5):
        measure(share)
        assert live._max_finest == pytest.approx(live._limit / share ** (1 / 1.5), rel=0.1), "of bytes"
    measure(0.0)
    assert live._max_finest == dynamic_resolution.ERROR_LIMITS_PX2[2]


def test_first_stop_fits_the_pyramid_once_and_keeps_later_changes() -> None:
    scene = bear(6000).gaussians
    live, camera = dynamic_resolution.LiveScene(scene), to_camera(first_camera(scene), *SIZE)
    full = np.full((SIZE[1], SIZE[0], 3), 0.5, np.float32)
    coarse = full[::2, ::2].copy()
    plain = live.begin_pyramid().result()
    small = camera.resize(SIZE[0] // 2, SIZE[1] // 2)
    live.draw_fewer(lambda fewer: None, small, 2)
    live.measure(coarse, full)
    assert live._fitted is not None
    rows = np.arange(100, 900)
    scene.sh0[rows] += 0.5
    scene.means[rows] += 0.01
    live.update(scene, ("means", "sh0"), rows)
    fitted = live._fitted.result()
    live.draw_fewer(lambda fewer: None, small, 2)
    assert live._pyramid is not None
    assert live._pyramid.result() is fitted is not plain
    assert not (fitted.nodes.visibility == 1.0).all()
    live.measure(coarse, full)
    assert live._fitted is None, "the fit is made once"
    merged = [array.copy() for array in fitted.nodes[:2]]
    fitted.refresh(np.arange(len(scene)), colors_only=False)
    assert all(map(np.array_equal, merged, fitted.nodes[:2])), "nothing was behind"


def test_failed_fit_is_reported_once_and_the_first_pyramid_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise ValueError("a camera of no size")

    scene = bear(3000).gaussians
    live, camera = dynamic_resolution.LiveScene(scene), to_camera(first_camera(scene), *SIZE)
    plain = live.begin_pyramid().result()
    monkeypatch.setattr(dynamic_resolution, "fit_pyramid", fail)
    live.draw_fewer(lambda fewer: None, camera, 2)
    full = np.full((SIZE[1], SIZE[0], 3), 0.5, np.float32)
    live.measure(full[::2, ::2].copy(), full)
    assert live._fitted is not None
    assert live._fitted.exception() is not None
    with pytest.raises(ValueError, match="a camera of no size"):
        live.draw_fewer(lambda fewer: None, camera, 2)
    assert live.draw_fewer(lambda fewer: True, camera, 2)
    assert live._pyramid is not None
    assert live._pyramid.result() is plain


@pytest.mark.gl
@pytest.mark.parametrize("draw", ["cpu", "gl"])
def test_detail_is_measured_only_from_the_same_view(ctx: moderngl.Context, stack: Stack, draw: str) -> None:
    engine, view = ViewEngine(ctx, stack.scene, stack.gdfs, draw), view_of(stack, 0.1, 0.6)
    turned = replace(view, camera=replace(view.camera, azimuth=view.camera.azimuth + 30.0))
    slid = view_of(stack, 0.9, 0.6)
    black = replace(view, background=(0.0, 0.0, 0.0))
    framebuffer = ctx.simple_framebuffer(SIZE)
    first = dynamic_resolution.ERROR_LIMITS_PX2[1]

    def rest(moving: ViewState, rested: ViewState, grown: int = 0) -> float:
        engine.draw(moving, framebuffer, SIZE, pixels=2)
        dynamic_resolution._worker().submit(int).result()  # the pyramid is finished now
        engine.draw(replace(moving, background=(0.5, 0.5, 0.5)), framebuffer, SIZE, pixels=2)
        engine.draw(moving, framebuffer, SIZE, pixels=2)
        engine.draw(rested, framebuffer, (SIZE[0] + grown, SIZE[1]))
        live = (
            engine.renderer._scene if isinstance(engine.renderer, CpuRenderer) else engine.renderer._moving[0]
        )
        return live._max_finest

    for other in (turned, slid, black):
        assert rest(view, other) == first
    assert rest(view, view, grown=16) == first
    enough = rest(view, view)
    assert enough != first
    assert rest(turned, turned) != enough
    framebuffer.release()
    engine.release()


@pytest.mark.gl
@pytest.mark.parametrize("done", [1, 3])
def test_finished_bands_are_shown_before_the_others(
    ctx: moderngl.Context, stack: Stack, monkeypatch: pytest.MonkeyPatch, done: int
) -> None:
    monkeypatch.setattr(cpu_renderer, "BAND", len(stack.scene) // 2)
    monkeypatch.setattr(cpu_renderer, "MIN_ROWS", 40)
    screen = ctx.framebuffer([ctx.texture(SIZE, 4)])
    view = view_of(stack, 0.2, 0.6)
    view = replace(view, grid=True)
    engine = ViewEngine(ctx, stack.scene, stack.gdfs, draw="cpu")
    engine.draw(view, screen, SIZE)
    full = read_rgb(screen, SIZE)
    engine.draw(view, screen, SIZE, pixels=2)
    coarse = read_rgb(screen, SIZE)
    while not engine.prepare(view, to_camera(view.camera, *SIZE)):
        pass
    assert isinstance(engine.renderer, CpuRenderer)
    assert engine.renderer._pending is not None
    bands = engine.renderer._pending.bands
    assert bands == [(40, 80), (0, 40), (80, 120)], "the middle first"
    del bands[done:]
    assert engine.renderer.has_parts
    engine.draw(view, screen, SIZE, pixels=2)
    assert not engine.renderer.has_parts
    shown = read_rgb(screen, SIZE)
    for top, end in bands:
        coarse[top:end] = full[top:end]
    # grid lines come from the stretched coarse picture, so their ends may round differently
    assert np.abs(shown.astype(int) - coarse).mean() < 0.02
    engine.draw(view, screen, SIZE)
    assert np.array_equal(read_rgb(screen, SIZE), full)
    screen.release()
    engine.release()


def test_small_pyramid_compiles_the_kernels_of_large_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    made = list[Pyramid]()

    def build(gaussians: ActivatedGaussians) -> Pyramid:
        made.append(Pyramid(gaussians))
        return made[-1]

    monkeypatch.setattr(dynamic_resolution, "Pyramid", build)
    dynamic_resolution.warm_up()
    dynamic_resolution.LiveScene(bear(2000).gaussians).begin_pyramid().result()
    small, *_, large = made
    for sample, array in zip((*small.scene, *small.nodes[:4]), (*large.scene, *large.nodes[:4]), strict=True):
        assert (sample.dtype, sample.ndim) == (array.dtype, array.ndim)
        assert sample.flags.c_contiguous == array.flags.c_contiguous, "else each kernel compiles twice"
