"""Drawing only what a slider touches: the bits of a whole picture, in the array and on screen."""

from __future__ import annotations

from dataclasses import replace

import moderngl
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from progdf.camera import Camera
from progdf.field.baked import AttributeBases, BakedField
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf, fingerprint
from progdf.rasterize import activate, render
from progdf.rasterize.pixel_cells import CELL, MOST_RECTANGLES, area, dirty_rectangles, mark_cells, no_cells
from progdf.region import Region
from tests.helpers.stacks import Stack
from viewer.camera.view_camera import first_camera, to_camera
from viewer.gl.present import read_rgb
from viewer.render import cpu_renderer as cpu_renderer
from viewer.render.engine import ViewEngine
from viewer.state.view_state import LayerState, ViewState

SIZE = (160, 120)


@pytest.fixture(autouse=True)
def _small_boxes_pay(monkeypatch: pytest.MonkeyPatch) -> None:
    """As they would in a larger picture."""
    monkeypatch.setattr(cpu_renderer, "CALL_PIXELS", 64)
    monkeypatch.setattr(cpu_renderer, "GAUSSIAN_PIXELS", 0.0)


def view_of(stack: Stack, *strengths: float) -> ViewState:
    layers = tuple(LayerState(i, str(i), strength) for i, strength in enumerate(strengths))
    return ViewState(camera=first_camera(stack.scene, stack.demo.cameras), layers=layers)


def wandering(scene: Gaussians) -> Gdf:
    """An edit that sends members across the picture and out of it, behind the camera, up to giants, to
    nothing and back."""
    rng = torch.Generator().manual_seed(5)
    members = torch.randperm(len(scene), generator=rng)[:60].sort().values
    nodes = torch.tensor([0.0, 0.5, 1.0])

    def base(full: torch.Tensor) -> AttributeBases:
        none = torch.zeros(0, *full.shape, dtype=torch.int8)
        return AttributeBases(full, none, torch.zeros(0, full.shape[1]), nodes[:, None].clone())

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


def test_a_picture_that_was_begun_is_the_one_that_is_drawn_unless_something_changed(stack: Stack) -> None:
    engine, afresh = (ViewEngine(None, stack.scene, stack.gdfs) for _ in range(2))
    views = [view_of(stack, strength) for strength in (0.2, 0.9)]
    for begun in views:
        camera = to_camera(begun.camera, *SIZE)
        engine.image(begun, (SIZE[0] // 2, SIZE[1] // 2))
        while not engine.prepare(begun, camera):
            pass
        for shown in (begun, *views):
            np.testing.assert_array_equal(engine.image(shown, SIZE), afresh.image(shown, SIZE))
            engine.prepare(shown, replace(camera, viewmat=camera.viewmat + 0.01))  # which nobody asks for


def test_a_random_session_of_sliders_gives_the_bits_of_whole_pictures(stack: Stack) -> None:
    edits = (*stack.gdfs, wandering(stack.scene))
    kept = ViewEngine(None, stack.scene, edits)
    rng = np.random.default_rng(3)
    view = view_of(stack, 0.0, 0.0, 0.0)
    shares = []
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
        shares.append(kept.timings.share)
        fresh = ViewEngine(None, kept.gaussians(view))
        assert np.array_equal(image, fresh.image(replace(view, layers=()), SIZE)), step
    assert sum(0.0 < share < 0.8 for share in shares) >= 15, "hardly any picture was drawn in part"


def _camera(view: ViewState) -> Camera:
    return to_camera(view.camera, *SIZE)


def test_a_picture_that_was_handed_out_stays_as_it_is(stack: Stack) -> None:
    engine = ViewEngine(None, stack.scene, stack.gdfs)
    engine.image(view_of(stack, 0.1), SIZE)
    image = engine.image(view_of(stack, 0.4), SIZE)
    before = image.copy()
    again = engine.image(view_of(stack, 0.9), SIZE)
    assert 0.0 < engine.timings.share < 0.8
    assert np.array_equal(image, before)
    assert not np.array_equal(again, before)


def test_where_many_are_touched_the_picture_is_drawn_as_a_whole(
    stack: Stack, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cpu_renderer, "MANY", 3)
    engine, fresh = ViewEngine(None, stack.scene, stack.gdfs), ViewEngine(None, stack.scene, stack.gdfs)
    engine.image(view_of(stack, 0.2), SIZE)
    changed = engine.image(view_of(stack, 0.7), SIZE)
    assert engine.timings.share == 1.0
    assert np.array_equal(changed, fresh.image(view_of(stack, 0.7), SIZE))


def test_several_changes_before_a_picture_are_all_drawn(stack: Stack) -> None:
    engine = ViewEngine(None, stack.scene, stack.gdfs)
    engine.image(view_of(stack, 0.5, 0.5), SIZE)
    engine.gaussians(view_of(stack, 0.9, 0.5))  # composes, draws nothing
    view = view_of(stack, 0.9, 0.1)
    fresh = ViewEngine(None, stack.scene, stack.gdfs)
    assert np.array_equal(engine.image(view, SIZE), fresh.image(view, SIZE))
    assert 0.0 < engine.timings.share < 0.8


def test_the_share_is_small_where_few_are_touched(stack: Stack) -> None:
    engine = ViewEngine(None, stack.scene, stack.gdfs)
    engine.image(view_of(stack, 0.5), SIZE)
    assert engine.timings.share == 1.0
    engine.image(view_of(stack, 0.6), SIZE)
    assert 0.0 < engine.timings.share < 0.3
    engine.image(replace(view_of(stack, 0.6), background=(0.0, 0.0, 0.0)), SIZE)
    assert engine.timings.share == 1.0


@pytest.mark.gl
def test_the_screen_follows_the_touched_part(ctx: moderngl.Context, stack: Stack) -> None:
    screen = ctx.framebuffer([ctx.texture(SIZE, 4)])
    engine, fresh = (ViewEngine(ctx, stack.scene, stack.gdfs, draw="cpu") for _ in range(2))
    for scarf, ears in ((0.0, 0.0), (0.5, 0.0), (1.0, 0.3), (1.0, 0.9), (0.0, 0.9)):
        engine.image(view_of(stack, scarf, 0.5 * ears), SIZE)  # a picture that never reaches the screen
        engine.draw(view_of(stack, scarf, ears), screen, SIZE)
        shown = read_rgb(screen, SIZE)
        image = np.round(np.clip(fresh.image(view_of(stack, scarf, ears), SIZE), 0.0, 1.0) * 255.0)
        assert np.abs(shown.astype(int) - image).max() <= 1
    for held in (engine, fresh, screen):
        held.release()


def test_marked_cells_hold_every_pixel_that_a_gaussian_changes(stack: Stack) -> None:
    """Needles, giants, faint ones, some behind the camera; each alone on white."""
    rng = torch.Generator().manual_seed(11)
    camera = _camera(view_of(stack))
    count = 120
    scene = replace(
        stack.scene[:count],
        means=stack.scene.means[:count] + torch.randn(count, 3, generator=rng),
        log_scales=torch.empty(count, 3).uniform_(-9.0, 1.0, generator=rng),
        logit_opacities=torch.empty(count).uniform_(-6.0, 6.0, generator=rng),
        sh0=torch.full((count, 3), -1.0),
    )
    activated = activate(scene)
    seen = 0
    for i in range(count):
        cells = no_cells(*SIZE)
        mark_cells(cells, activated, np.array([i]), camera)
        pixels = np.kron(cells, np.ones((CELL, CELL), bool))[: SIZE[1], : SIZE[0]]
        changed = (render(scene[i : i + 1], camera).image.numpy() != 1.0).any(axis=2)
        assert not (changed & ~pixels).any(), i
        seen += bool(changed.any())
    assert seen > count // 3


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 14), st.integers(0, 19)), max_size=12),
    st.integers(0, 2000),
)
def test_boxes_hold_all_marks_and_do_not_overlap(marks: list[tuple[int, int]], worth: int) -> None:
    cells = np.zeros((15, 20), np.bool_)
    for row, column in marks:
        cells[row, column] = True
    size = (20 * CELL - 3, 15 * CELL - 5)
    found = dirty_rectangles(cells, size, worth)
    cover: NDArray[np.int64] = np.zeros((size[1], size[0]), np.int64)
    for x0, y0, x1, y1 in found:
        assert 0 <= x0 < x1 <= size[0]
        assert 0 <= y0 < y1 <= size[1]
        cover[y0:y1, x0:x1] += 1
    assert cover.max(initial=0) <= 1
    assert (cover[np.kron(cells, np.ones((CELL, CELL), bool))[: size[1], : size[0]]] == 1).all()
    assert len(found) <= MOST_RECTANGLES
    assert area(found) == cover.sum()


def test_two_far_corners_are_two_small_boxes() -> None:
    cells = np.zeros((15, 20), np.bool_)
    cells[0, 0] = cells[14, 19] = True
    assert area(dirty_rectangles(cells, (160, 120), 1000)) == 2 * CELL**2
    assert len(dirty_rectangles(cells, (160, 120), 10**6)) == 1
