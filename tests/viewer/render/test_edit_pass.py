"""The GPU's edit pass against `compose_layers`: blend rules, kinds of field, weights, gains; exact ends."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import moderngl
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from progdf.compose.reference import BLENDS, Gains, Layer, compose_layers
from progdf.field import BakedField, fit_keyframes
from progdf.field.keyframes import fit_lossless
from progdf.gaussians import ATTRIBUTES, Gaussians
from progdf.gdf.file import Gdf
from tests.helpers.edits import curved_field, curved_trajectory, edit_of, some_rows
from tests.helpers.scenes import random_gaussians
from viewer.gl import edit_pass as edit_pass_module
from viewer.gl.edit_packing import spans_of
from viewer.gl.edit_pass import EditPass, EditPassError
from viewer.gl.layout import PLACES, SHOWN_SH, SPLATS_PER_ROW
from viewer.gl.scene_textures import SplatTextures
from viewer.render.edit_sample import EditSample, difference

pytestmark = pytest.mark.gl
COUNT = 2 * SPLATS_PER_ROW + 100
FEW_ULPS = 1e-6  # a driver may fuse or reorder a handful of float32 products; llvmpipe gives the CPU's bits
Stack = Sequence[tuple[int, Layer]]


class Edited:
    """A scene in textures, and the pass that edits it there."""

    def __init__(self, ctx: moderngl.Context, scene: Gaussians, gdfs: Sequence[Gdf]) -> None:
        self.scene, self.gdfs = scene, gdfs
        shown = min(int(scene.shN.shape[1]), SHOWN_SH)
        self.textures = SplatTextures(ctx, len(scene), shown, editable=True)
        self.textures.write(scene)
        self.edit_pass = EditPass(ctx, self.textures, scene, gdfs)

    def update(self, stack: Stack, blend: str = "normalized", changed: Sequence[int] | None = None) -> None:
        edits = frozenset(range(len(self.gdfs)) if changed is None else changed)
        self.edit_pass.run([(edit, layer) for edit, layer in stack if layer.active], blend, edits)

    def found(self) -> dict[str, NDArray[np.float32]]:
        """All attributes as they are in the textures. [N,c]"""
        read = {}
        for name, place in PLACES.items():
            if name == "shN" and not self.textures.sh_coefficients:
                continue
            texels = np.frombuffer(self.textures.textures[place.texture].read(), np.float32)
            width = self.textures.sh_coefficients if name == "shN" else 1
            texels = texels.reshape(-1, width, 4)[: len(self.scene)]
            columns = texels[..., place.component : place.component + place.components]
            read[name] = columns.reshape(len(self.scene), width * place.components)
        return read

    def apart(self, expected: Gaussians) -> float:
        return max(
            difference(got, rows_of(expected, name)[:, : got.shape[1]]) for name, got in self.found().items()
        )

    def same_bits(self, expected: Gaussians) -> bool:
        return all(
            got.tobytes() == np.ascontiguousarray(rows_of(expected, name)[:, : got.shape[1]]).tobytes()
            for name, got in self.found().items()
        )

    def release(self) -> None:
        self.edit_pass.release()
        self.textures.release()


def rows_of(scene: Gaussians, name: str) -> NDArray[np.float32]:
    values = getattr(scene, name)
    return values.reshape(len(scene), math.prod(values.shape[1:])).numpy()


def signed_zeros(scene: Gaussians) -> Gaussians:
    """Every third number a −0, which a careless sum turns into a 0."""
    changed = {}
    for name in ATTRIBUTES:
        values = getattr(scene, name).clone()
        values.view(-1)[::3] = -0.0
        changed[name] = values
    return replace(scene, **changed)


def channels_of(scene: Gaussians) -> int:
    return 14 + 3 * int(scene.shN.shape[1])


def gdf_of(scene: Gaussians, members: int, seed: int, **field: object) -> Gdf:
    made = curved_field(members, seed, channels_of(scene), **field)  # type: ignore[arg-type]
    for bases in made.attributes.values():
        bases.end_offset[::2] = -0.0
    return edit_of(scene, some_rows(scene, members, seed), made, f"edit {seed}")


@pytest.fixture(scope="module")
def edited(ctx: moderngl.Context) -> Iterator[Edited]:
    """Four overlapping edits: int8 bases, color alone, float32 bases, places and SH without a basis."""
    scene = signed_zeros(random_gaussians(COUNT, seed=3, sh_degree=2))
    gdfs = [
        gdf_of(scene, 400, 1),
        gdf_of(scene, 300, 2, moving=("sh0",)),
        gdf_of(scene, 500, 4, rest_type=torch.float32),
        gdf_of(scene, 200, 5, moving=("means", "shN"), rank=0),
    ]
    made = Edited(ctx, scene, gdfs)
    yield made
    made.release()


def painted(members: int, seed: int = 0) -> torch.Tensor:
    weights = torch.rand(members, generator=torch.Generator().manual_seed(seed))
    weights[::3] = 0.0
    weights[1::5] = 1.0
    return weights


@pytest.mark.parametrize("blend", BLENDS)
def test_overlapping_layers_are_what_compose_gives(edited: Edited, blend: str) -> None:
    layers = [Layer(gdf, s) for gdf, s in zip(edited.gdfs, (0.7, 0.4, 1.0, 0.55), strict=True)]
    edited.update(list(enumerate(layers)), blend)
    assert edited.apart(compose_layers(edited.scene, layers, blend)) <= FEW_ULPS


@pytest.mark.parametrize("blend", BLENDS)
def test_painted_weights_gains_and_overshoot_are_what_compose_gives(edited: Edited, blend: str) -> None:
    layers = [
        Layer(edited.gdfs[2], 1.2, gains=Gains(geometry=0.5), weights=painted(500)),
        Layer(edited.gdfs[0], 0.6, gains=Gains(geometry=0.0, opacity=0.3)),
        Layer(edited.gdfs[3], 0.9, gains=Gains(color=0.0), weights=painted(200, 1)),
    ]
    edited.update(list(zip((2, 0, 3), layers, strict=True)), blend)
    assert edited.apart(compose_layers(edited.scene, layers, blend)) <= FEW_ULPS


@settings(max_examples=25, deadline=None)
@given(
    path=st.lists(
        st.tuples(
            st.integers(0, 3),
            st.sampled_from([0.0, 0.25, 0.61, 1.0, 1.2]),
            st.sampled_from([0.0, 0.5, 1.0]),
            st.booleans(),
        ),
        max_size=6,
    ),
    blend=st.sampled_from(BLENDS),
)
def test_any_stack_is_what_compose_gives(
    edited: Edited, path: list[tuple[int, float, float, bool]], blend: str
) -> None:
    stack = [
        (edit, Layer(edited.gdfs[edit], s, True, Gains(gain, 1.0, gain), _weights(edited, edit, paints)))
        for edit, s, gain, paints in path
    ]
    edited.update(stack, blend)
    assert edited.apart(compose_layers(edited.scene, [layer for _, layer in stack], blend)) <= FEW_ULPS


def _weights(edited: Edited, edit: int, paints: bool) -> torch.Tensor | None:
    return painted(len(edited.gdfs[edit].region), edit) if paints else None


@pytest.mark.parametrize("blend", BLENDS)
def test_strength_zero_is_the_original_bit_for_bit(edited: Edited, blend: str) -> None:
    edited.update([(0, Layer(edited.gdfs[0], 0.8)), (2, Layer(edited.gdfs[2], 0.7))], blend)
    assert not edited.same_bits(edited.scene)
    edited.update([(0, Layer(edited.gdfs[0], 0.0)), (2, Layer(edited.gdfs[2], -0.0))], blend)
    assert edited.same_bits(edited.scene)


@pytest.mark.parametrize("blend", BLENDS)
@pytest.mark.parametrize("edit", range(4))
def test_one_layer_at_full_strength_is_the_recorded_end_bit_for_bit(
    edited: Edited, edit: int, blend: str
) -> None:
    edited.update([(edit, Layer(edited.gdfs[edit], 1.0))], blend)
    assert edited.same_bits(compose_layers(edited.scene, [Layer(edited.gdfs[edit], 1.0)], blend))


def test_rows_of_weight_zero_and_kinds_of_gain_zero_keep_their_bits(edited: Edited) -> None:
    weights = painted(400)
    layer = Layer(edited.gdfs[0], 0.6, gains=Gains(opacity=0.0), weights=weights)
    edited.update([(0, layer)])
    unpainted = edited.gdfs[0].region.members[weights == 0.0].numpy()
    for name, got in edited.found().items():
        rows = slice(None) if name == "logit_opacities" else unpainted
        assert got[rows].tobytes() == rows_of(edited.scene, name)[rows].tobytes(), name


def test_a_layer_leaves_the_members_of_others_alone(edited: Edited) -> None:
    edited.update([])
    edited.update([(1, Layer(edited.gdfs[1], 0.5))], changed=[1])
    assert edited.apart(compose_layers(edited.scene, [Layer(edited.gdfs[1], 0.5)])) <= FEW_ULPS
    outside = np.setdiff1d(np.arange(COUNT), edited.gdfs[1].region.members.numpy())
    for name, got in edited.found().items():
        original = rows_of(edited.scene, name)
        columns = outside if name == "sh0" else slice(None)
        assert got[columns].tobytes() == original[columns].tobytes(), name


def test_weights_that_torch_writes_into_are_seen(edited: Edited) -> None:
    weights = torch.ones(400)
    layer = Layer(edited.gdfs[0], 0.7, weights=weights)
    edited.update([(0, layer)])
    weights[:200] = 0.25
    edited.update([(0, layer)])
    assert edited.apart(compose_layers(edited.scene, [layer])) <= FEW_ULPS


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_every_band_of_spherical_harmonics_is_edited(ctx: moderngl.Context, degree: int) -> None:
    scene = random_gaussians(300, seed=degree, sh_degree=degree)
    made = Edited(ctx, scene, [gdf_of(scene, 120, 1)])
    layer = Layer(made.gdfs[0], 0.6)
    made.update([(0, layer)])
    assert made.apart(compose_layers(scene, [layer])) <= FEW_ULPS
    assert made.apart(scene) > 0.1
    made.release()


def _fields(members: int) -> dict[str, BakedField]:
    strengths, offsets = curved_trajectory(members, 7, snapshots=33)
    mixed = curved_field(members, 8, moving=("means", "sh0"))
    halves = curved_field(members, 9, moving=("logit_opacities",), rank=5, rest_type=torch.float16)
    return {
        "33 snapshots": fit_lossless(strengths, offsets),
        "4 keyframes": fit_keyframes(strengths, offsets, 4),
        "int8 keyframes": fit_keyframes(strengths, offsets, 5, rest_type=torch.int8),
        "other types and ranks in one texture": replace(
            mixed, attributes={**mixed.attributes, **halves.attributes}
        ),
        "an edit of nothing": replace(mixed, attributes={}),
    }


@pytest.mark.parametrize("kind", list(_fields(4)))
def test_every_form_of_field_is_what_compose_gives(ctx: moderngl.Context, kind: str) -> None:
    scene = random_gaussians(COUNT, seed=2)
    gdf = edit_of(scene, some_rows(scene, 150, 3), _fields(150)[kind])
    made = Edited(ctx, scene, [gdf])
    for s in (0.013, 0.5, 0.77, 1.2):
        made.update([(0, Layer(gdf, s))])
        assert made.apart(compose_layers(scene, [Layer(gdf, s)])) <= FEW_ULPS, s
    made.update([(0, Layer(gdf, 1.0))])
    assert made.same_bits(compose_layers(scene, [Layer(gdf, 1.0)]))
    made.release()


@pytest.mark.parametrize("count", [0, 1, SPLATS_PER_ROW])
def test_edits_without_members_and_tiny_scenes_are_survived(ctx: moderngl.Context, count: int) -> None:
    scene = random_gaussians(count, seed=1)
    gdfs = [gdf_of(scene, 0, 1), gdf_of(scene, count, 2)]
    made = Edited(ctx, scene, gdfs)
    layers = [Layer(gdf, 0.5) for gdf in gdfs]
    made.update(list(enumerate(layers)))
    assert made.apart(compose_layers(scene, layers)) <= FEW_ULPS
    assert EditSample(scene, gdfs).error(made.edit_pass, list(enumerate(layers)), "normalized") <= FEW_ULPS
    assert ctx.error == "GL_NO_ERROR"
    made.release()


def test_huge_offsets_overflow_as_they_do_on_the_cpu(ctx: moderngl.Context) -> None:
    scene = random_gaussians(60, seed=1)
    scene.means[3], scene.sh0[4] = float("nan"), float("inf")
    field = curved_field(60, 1)
    big = {
        name: replace(bases, end_offset=bases.end_offset * scale)
        for (name, bases), scale in zip(
            field.attributes.items(), (1e30, 3e38, 1e-30, 1e18, -3e38), strict=True
        )
    }
    gdf = edit_of(scene, torch.arange(60), replace(field, attributes=big))
    made = Edited(ctx, scene, [gdf])
    for s in (0.3, 1.0, 1.2):
        made.update([(0, Layer(gdf, s))])
        assert made.apart(compose_layers(scene, [Layer(gdf, s)])) <= FEW_ULPS, s
    made.release()


def test_spans_cover_the_members_and_nothing_else() -> None:
    slots = np.arange(0, 3000, 2)
    slots = np.union1d(slots, np.arange(500, 1100))
    rows = np.setdiff1d(slots, [502, 900])
    covered, slot_of = [], []
    for span in spans_of(rows, slots):
        texel = span["row"] * SPLATS_PER_ROW + span["column"] + np.arange(span["texels"])
        assert span["column"] + span["texels"] <= SPLATS_PER_ROW
        covered.append(texel)
        slot_of.append(span["slot"] + np.arange(span["texels"]))
    assert np.concatenate(covered).tolist() == rows.tolist()
    assert np.array_equal(slots[np.concatenate(slot_of)], rows)


def test_a_region_in_one_piece_is_one_span_a_texture_row() -> None:
    rows = np.arange(100, 100 + 3 * SPLATS_PER_ROW)
    assert len(spans_of(rows, rows)) == 4
    assert len(spans_of(rows[:0], rows)) == 0


def test_what_is_sent_for_a_new_strength_does_not_grow_with_members_or_scene(
    ctx: moderngl.Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent: list[int] = []
    write = edit_pass_module.TexelList.write
    monkeypatch.setattr(
        edit_pass_module.TexelList, "write", lambda self, texels: sent.append(write(self, texels)) or sent[-1]
    )
    taken = []
    for count, members in ((100, 20), (COUNT, 900)):
        scene = random_gaussians(count)
        made = Edited(ctx, scene, [gdf_of(scene, members, 1)])
        made.update([(0, Layer(made.gdfs[0], 0.4))])
        sent.clear()
        made.update([(0, Layer(made.gdfs[0], 0.5))])
        taken.append(sum(sent))
        made.release()
    assert taken[0] == taken[1] < 500


def test_edits_that_no_texture_can_hold_are_refused(
    ctx: moderngl.Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(edit_pass_module, "capacity", lambda _: 1000)
    scene = random_gaussians(300)
    textures = SplatTextures(ctx, 300, 0, editable=True)
    with pytest.raises(EditPassError, match="too large"):
        EditPass(ctx, textures, scene, [gdf_of(scene, 200, 1)])
    textures.release()


def test_the_sample_sees_a_wrong_texel(edited: Edited) -> None:
    """By a rule that looks at each member for itself: what "over" hides follows from all members of an edit
    (their size, a tenth of their changes), of which the sample holds a part.
    """
    sample = EditSample(edited.scene, edited.gdfs)
    stack = [(0, Layer(edited.gdfs[0], 0.5, weights=painted(400))), (3, Layer(edited.gdfs[3], 0.9))]
    edited.update(stack, "sum")
    assert sample.error(edited.edit_pass, stack, "sum") <= FEW_ULPS
    middle = int(edited.gdfs[0].region.members[200])
    place = (middle % SPLATS_PER_ROW, middle // SPLATS_PER_ROW, 1, 1)
    edited.textures.textures["quat"].write(np.full(4, 7.0, np.float32), viewport=place)
    assert sample.error(edited.edit_pass, stack, "sum") > 0.1


def test_differences_of_numbers_that_are_not_finite() -> None:
    nan, inf = np.float32("nan"), np.float32("inf")
    found = np.array([nan, inf, 2000.0, 0.5], np.float32)
    assert difference(found, np.array([nan, inf, 1000.0, 0.25], np.float32)) == 1.0
    assert difference(found[:1], np.zeros(1, np.float32)) == np.inf
    assert difference(found[1:2], -found[1:2]) == np.inf
    assert difference(found[:0], found[:0]) == 0.0
