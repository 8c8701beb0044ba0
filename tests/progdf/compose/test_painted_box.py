"""Pictures of a painted box that is removed, moved, scaled and turned, from six sides."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from progdf.compose.composer import Composer
from progdf.compose.layers import BLENDS, Layer
from progdf.compose.reference import compose_layers, edited_scene
from progdf.gaussians import Gaussians
from progdf.metrics.image import psnr
from progdf.rasterize import render
from progdf.region import from_mask
from progdf.tidy import Step, bake, similarity, tidy
from tests.helpers.painted_box import PaintedBox, painted_box, six_cameras

MOTIONS = {
    "moved": similarity(shift=(0.8, -0.4, -0.5)),
    "scaled": similarity(scale=0.6),
    "turned": similarity(shift=(-0.5, 0.0, 0.0), turn=(0.2, 0.3, 0.9), scale=1.3),
}


@pytest.fixture(scope="module")
def painted() -> PaintedBox:
    return painted_box()


def pictures(scene: Gaussians) -> Tensor:
    return torch.stack([render(scene, camera, (0.2, 0.4, 0.9)).image for camera in six_cameras()])


def test_the_paint_is_visible(painted: PaintedBox) -> None:
    before = pictures(painted.scene)
    after = pictures(edited_scene(painted.scene, painted.paint))
    changed = (after - before).abs().amax(dim=3).flatten(1).amax(dim=1)
    assert float(changed[0]) > 0.3, "from the front"
    assert float(changed[2]) < 0.01, "from behind"


@pytest.mark.parametrize("blend", BLENDS)
def test_removed_box_leaves_no_paint_in_the_air(painted: PaintedBox, blend: str) -> None:
    remove = tidy(painted.scene, [Step("remove", painted.box)], "remove")
    alone = pictures(compose_layers(painted.scene, [Layer(remove)], blend))
    both = pictures(compose_layers(painted.scene, [Layer(painted.paint), Layer(remove)], blend))
    assert float((both - alone).abs().max()) < 1e-6


@pytest.mark.parametrize("how", MOTIONS)
def test_moved_box_looks_like_one_that_was_painted_there(painted: PaintedBox, how: str) -> None:
    move = tidy(painted.scene, [Step("transform", painted.box, MOTIONS[how])], "move")
    layers = [Layer(painted.paint), Layer(move)]
    composer = Composer(painted.scene, [painted.paint, move])
    composer.update(layers, "adjust")
    baked = edited_scene(painted.scene, painted.paint)
    mask = torch.ones(len(baked), dtype=torch.bool)
    mask[: len(painted.scene)] = painted.box.mask
    motion = MOTIONS[how]
    # the box turns about its own center, not about that of box and paint
    center = painted.scene.means[painted.box.members].double().mean(dim=0)
    about_box = replace(motion, pivot=center)
    expected = pictures(bake(baked, [Step("transform", from_mask("all", mask), about_box)]))
    for composed in (composer.gaussians, compose_layers(painted.scene, layers, "adjust")):
        assert psnr(pictures(composed), expected) > 50.0


def test_object_moved_without_its_paint_leaves_it_in_place(painted: PaintedBox) -> None:
    steps = [Step("transform", painted.box, MOTIONS["moved"])]
    move = tidy(painted.scene, steps, "move", leaves_paint=True)
    count = len(painted.scene)
    alone = compose_layers(painted.scene, [Layer(painted.paint)])
    both = compose_layers(painted.scene, [Layer(painted.paint), Layer(move)])
    assert torch.equal(both.means[count:], alone.means[count:])
    moved = compose_layers(painted.scene, [Layer(move)])
    for name in ("means", "logit_opacities", "sh0"):
        error = getattr(both, name)[:count] - getattr(moved, name)[:count]
        assert float(error.abs().max()) < 1e-5, "the object has its own surface again"
    composer = Composer(painted.scene, [painted.paint, move])
    for strength in (1.0, 0.4, 0.0, 0.7):
        layers = [Layer(painted.paint, 0.8), Layer(move, strength)]
        composer.update(layers)
        expected = compose_layers(painted.scene, layers)
        for name in ("means", "log_scales", "logit_opacities", "sh0"):
            assert torch.allclose(getattr(composer.gaussians, name), getattr(expected, name), atol=1e-5)
