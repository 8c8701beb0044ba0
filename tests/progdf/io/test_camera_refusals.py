"""Tests of broken or unsupported camera files: each is refused in one line."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from progdf.errors import ProgdfError
from progdf.io.cameras import load_cameras, load_cameras_with_report, save_cameras
from tests.helpers.camera_tables import REFUSED_VIEWMATS, inria, nerfstudio, some_cameras, written
from tests.helpers.refused import refusal


def test_picture_without_a_readable_size_is_reported_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = nerfstudio(some_cameras()[:1], w=None, h=None)
    (tmp_path / "images").mkdir()
    picture = tmp_path / content["frames"][0]["file_path"]
    picture.write_text("no picture")
    path = written(tmp_path / "t.json", content)
    assert f"has no image size, and {picture} cannot be read as a picture" in refusal(load_cameras, path)
    Image.new("RGB", (320, 200)).save(picture)
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1000)
    assert f"has no image size, and {picture} cannot be read as a picture" in refusal(load_cameras, path)


def test_ambiguous_distortion_is_refused(tmp_path: Path) -> None:
    for key in ("k4", "k5", "k6"):
        assert "undistort" in refusal(
            load_cameras, written(tmp_path / "t.json", nerfstudio(some_cameras(), **{key: 0.01}))
        )


def test_overlong_camera_file_name_is_reported_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(ProgdfError, match="cannot be read \\(File name too long\\)"):
        load_cameras(tmp_path / ("9" * 5000))


LENSES = {  # as nerfstudio, instant-ngp and others write them
    "is_fisheye": True,
    "camera_model": "OPENCV_FISHEYE",
    "camera_type": "fisheye",
    "ftheta_p0": 0.1,
    "latlong": True,
    "equirectangular": True,
    "orthographic": True,
    "rolling_shutter": [0.0, 0.0, 0.03, 0.0],
    "transform_matrix_start": [[1, 0, 0, 0]],
    "distortion_params": [0.1, 0, 0, 0, 0, 0],
    "xi": 0.9,
    "b1": 0.3,
    "intrinsic_matrix": [[1]],
    "from_na": True,
}


@pytest.mark.parametrize("field", LENSES)
@pytest.mark.parametrize("place", ["file", "frame"])
def test_other_lenses_are_refused_by_name(tmp_path: Path, field: str, place: str) -> None:
    content = nerfstudio(some_cameras())
    (content if place == "file" else content["frames"][2])[field] = LENSES[field]
    message = refusal(load_cameras, written(tmp_path / "t.json", content))
    assert message.startswith("frame 0 of " if place == "file" else "frame 2 of ")
    assert (LENSES[field] if field.startswith("camera_") else f"'{field}'") in message
    assert "which is not supported; " in message


@pytest.mark.parametrize("model", ["EQUIRECTANGULAR", "ORTHOPHOTO", "VR180_L", "FISHEYE624", "FOV", 7])
def test_other_camera_models_are_refused_by_name(tmp_path: Path, model: object) -> None:
    path = written(tmp_path / "t.json", nerfstudio(some_cameras(), camera_model=model))
    assert f"the camera model {model}, which is not supported" in refusal(load_cameras, path)


@pytest.mark.parametrize(
    ("field", "value"),
    [("is_fisheye", True), ("scale", 2.0), ("trans", [0.0, 0.0, 1.0]), ("k4", 0.1), ("skew", 0.2)],
)
def test_inria_fields_that_change_the_camera_are_refused(tmp_path: Path, field: str, value: object) -> None:
    entries = inria(some_cameras())
    entries[1][field] = value
    message = refusal(load_cameras, written(tmp_path / "cameras.json", entries))
    assert message.startswith("camera 1 of ")
    assert f"'{field}'" in message


def test_unknown_fields_of_saved_cameras_are_listed_or_refused(tmp_path: Path) -> None:
    path = tmp_path / "cameras.json"
    save_cameras(path, some_cameras())
    content = json.loads(path.read_text(encoding="utf-8"))
    content["cameras"][1]["shutter"] = "closed"
    path.write_text(json.dumps(content), encoding="utf-8")
    cameras, report = load_cameras_with_report(path)
    assert len(cameras) == 4
    assert report.ignored == ("shutter",)
    content["cameras"][1]["is_fisheye"] = True
    path.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(ProgdfError, match=r"camera 1 of .*'is_fisheye' \(a fisheye lens\)"):
        load_cameras(path)


def test_inria_camera_without_focal_length_is_refused(tmp_path: Path) -> None:
    entries = inria(some_cameras())
    for key in ("fx", "fy"):
        del entries[0][key]
    assert "no focal length" in refusal(load_cameras, written(tmp_path / "cameras.json", entries))


@pytest.mark.parametrize("case", REFUSED_VIEWMATS)
def test_viewmat_must_be_a_rotation_and_a_translation(case: str) -> None:
    change, fault = REFUSED_VIEWMATS[case]
    camera = some_cameras()[0]
    with pytest.raises(ValueError, match=rf"the viewmat {fault}.*; it must be a rotation and a translation"):
        replace(camera, viewmat=change @ camera.viewmat)


def test_intrinsics_must_have_no_unused_entries() -> None:
    camera = some_cameras()[0]
    oblique = camera.K.clone()
    oblique[0, 1] = 3.0
    with pytest.raises(ValueError, match="K has oblique axes"):
        replace(camera, K=oblique)
    with pytest.raises(ValueError, match="K has the last row"):
        replace(camera, K=2.0 * camera.K)


Change = Callable[[dict[str, Any]], object]


def angle_instead(content: dict[str, Any], angle: float) -> None:
    """Replace the focal lengths by a field of view."""
    del content["fl_x"], content["fl_y"]
    content["camera_angle_x"] = angle


BROKEN: dict[str, tuple[Change, str]] = {  # change of a valid file, and expected error
    "fisheye": (lambda t: t.update(camera_model="OPENCV_FISHEYE"), "OPENCV_FISHEYE"),
    "no focal length": (lambda t: (t.pop("fl_x"), t.pop("fl_y")), "focal length"),
    "words": (lambda t: t.update(fl_x="wide"), "fl_x"),
    "endless integer": (lambda t: t.update(fl_x=10**400), "100000000000…"),
    "no matrix": (lambda t: t["frames"][3].pop("transform_matrix"), "frame 3"),
    "a row gone": (lambda t: t["frames"][3]["transform_matrix"].pop(0), "not a rotation"),
    "ragged matrix": (lambda t: t["frames"][3]["transform_matrix"][1].pop(), "transform_matrix"),
    "stretched": (
        lambda t: t["frames"][1]["transform_matrix"][0].__setitem__(slice(0, 3), [9, 0, 0]),
        "rotation",
    ),
    "mirrored": (
        lambda t: t["frames"][1]["transform_matrix"].insert(0, t["frames"][1]["transform_matrix"].pop(1)),
        "rotation",
    ),
    "NaN": (lambda t: t["frames"][1]["transform_matrix"][0].__setitem__(0, math.nan), "NaN is not a usable"),
    "frame is a number": (lambda t: t["frames"].append(7), "frame 4"),
    "no frames": (lambda t: t["frames"].clear(), "no cameras"),
    "a row too many": (
        lambda t: t["frames"][3]["transform_matrix"].append([0, 0, 0, 1]),
        "matrix is [[",
    ),
    "a little stretched": (
        lambda t: t["frames"][1].update(
            transform_matrix=[[1.02 * x for x in row] for row in t["frames"][1]["transform_matrix"][:3]]
        ),
        "not a rotation",
    ),
    "no angle": (lambda t: angle_instead(t, 0.0), "camera_angle_x is 0.0, expected float > 0.0"),
    "an angle in degrees": (
        lambda t: angle_instead(t, 50.0),
        "camera_angle_x is 50.0, expected float < 3",
    ),
    "truth for a number": (lambda t: t.update(w=True), "w is True"),
    "a billion pixels": (lambda t: t.update(w=10**9), "w is 1000000000"),
    "half a pixel": (lambda t: t.update(w=320.5), "w is 320.5, expected a whole number"),
    "no pixels": (lambda t: t.update(h=0), "h is 0"),
    "negative focal length": (lambda t: t.update(fl_y=-5.0), "focal lengths"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_broken_camera_is_named_in_one_line(case: str, tmp_path: Path) -> None:
    change, said = BROKEN[case]
    content = nerfstudio(some_cameras())
    change(content)
    assert said in refusal(load_cameras, written(tmp_path / "t.json", content))


@pytest.mark.parametrize(
    "content",
    [
        *("", "nonsense", "{", "{}", "[]", "[1, 2]", '{"frames": 3}', "[" * 5000, "7", "\x00\xff"),
        '[{"rotation": 1, "position": 2}]',
    ],
)
def test_any_other_json_is_reported_in_one_line(content: str, tmp_path: Path) -> None:
    path = tmp_path / "cameras.json"
    path.write_bytes(content.encode("latin-1"))
    refusal(load_cameras, path)


@pytest.mark.parametrize("diagonal", [(0, 0, 0, 0), (2, 2, 2, 1), (-1, 1, 1, 1), (1, 1, 1, 2)])
def test_saved_camera_that_is_no_rigid_motion_is_refused(diagonal: tuple[int, ...], tmp_path: Path) -> None:
    viewmat = torch.diag(torch.tensor(diagonal)).tolist()
    entry = {"width": 4, "height": 4, "K": torch.eye(3).tolist(), "viewmat": viewmat}
    assert "not a rotation" in refusal(load_cameras, written(tmp_path / "one.json", entry))


@pytest.mark.parametrize("sampling", [0, -1, 0.5, 17, 1e300, "2", None])
def test_invalid_sampling_is_refused(sampling: object, tmp_path: Path) -> None:
    entry = {"width": 4, "height": 4, "K": torch.eye(3).tolist(), "viewmat": torch.eye(4).tolist()}
    refusal(load_cameras, written(tmp_path / "one.json", entry | {"sampling": sampling}))


def test_missing_camera_file_is_reported_in_one_line(tmp_path: Path) -> None:
    assert "does not exist" in refusal(load_cameras, tmp_path / "nowhere.json")


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=4),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(
            st.sampled_from(["frames", "cameras", "viewmat", "K", "w", "fl_x", "rotation"]), inner
        )
    ),
    max_leaves=12,
)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(content=JSON, kind=st.sampled_from(["inria", "nerfstudio", "ours"]), data=st.data())
def test_any_value_in_any_field_loads_or_is_refused(
    content: object, kind: str, data: st.DataObject, tmp_path: Path
) -> None:
    entry: Any = inria(some_cameras())[0]
    whole: Any = [entry]
    if kind == "nerfstudio":
        whole = nerfstudio(some_cameras()[:1])
        entry = data.draw(st.sampled_from([whole, whole["frames"][0]]))
    if kind == "ours":
        entry = {
            "name": "a",
            "width": 4,
            "height": 4,
            "K": torch.eye(3).tolist(),
            "viewmat": torch.eye(4).tolist(),
        }
        whole = {"cameras": [entry]}
    entry[data.draw(st.sampled_from(sorted(entry)))] = content
    path = written(tmp_path / "fuzz.json", whole)
    try:
        cameras = load_cameras(path)
    except ProgdfError as refused:
        cameras = []
        message = str(refused)
        assert len(message.splitlines()) == 1
    for camera in cameras:
        assert bool(camera.viewmat.isfinite().all())
