"""Tests of regions: their language, their files and their set operations."""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.io.cameras import save_cameras
from progdf.region import Region, difference, from_mask, union
from progdf.scene.regions import check_region, parse_region, split_spec
from progdf.scene.selection import inside_polygon, inside_rectangle, inside_stroke, project_centers
from tests.helpers.scenes import orbit_camera, random_gaussians

COUNT = 200
KINDS = ("labels", "box", "sphere")


@pytest.fixture(scope="module")
def scene() -> Gaussians:
    return random_gaussians(COUNT, seed=2)


def labels_file(path: Path, seed: int = 0) -> np.ndarray:
    labels = np.random.default_rng(seed).integers(0, 5, COUNT).astype(np.uint8)
    np.save(path, labels)
    return labels


def members(spec: str, scene: Gaussians) -> set[int]:
    return set(parse_region(spec, scene).members.tolist())


def rows(mask: torch.Tensor | np.ndarray) -> set[int]:
    return set(np.flatnonzero(np.asarray(mask)).tolist())


# -------------------------------------------------------------------------------------------- language


def test_all_is_every_gaussian(scene: Gaussians) -> None:
    region = parse_region("all", scene)
    assert region.members.tolist() == list(range(COUNT))
    assert region.score.tolist() == [1.0] * COUNT
    assert region.name == "all"


def test_box_contains_centers_between_its_corners_in_any_order(scene: Gaussians) -> None:
    x, y, z = scene.means.unbind(1)
    expected = (x >= -0.5) & (x <= 1) & (y >= -1.5) & (y <= 0.1) & (z >= 0) & (z <= 9)
    assert members("box:-0.5,-1.5,0,1,1e-1,+9", scene) == rows(expected)
    assert members("box:1,1e-1,+9,-0.5,-1.5,0", scene) == rows(expected)


def test_sphere_contains_centers_within_its_radius(scene: Gaussians) -> None:
    distance = (scene.means - torch.tensor([0.1, -0.2, 0.3])).norm(dim=1)
    assert members("sphere:0.1,-0.2,.3,1.2", scene) == rows(distance <= 1.2)


def test_labels_choose_one_or_several_ids(scene: Gaussians, tmp_path: Path) -> None:
    labels = labels_file(tmp_path / "labels.npy")
    assert members(f"labels:{tmp_path}/labels.npy:3", scene) == rows(labels == 3)
    assert members(f"labels:{tmp_path}/labels.npy:0,4", scene) == rows((labels == 0) | (labels == 4))


def test_parts_join_from_left_to_right(scene: Gaussians, tmp_path: Path) -> None:
    labels = labels_file(tmp_path / "l.npy")
    near = scene.means.norm(dim=1).numpy() <= 1
    spec = f"labels:{tmp_path}/l.npy:1 + labels:{tmp_path}/l.npy:2 - sphere:0,0,0,1"
    assert members(spec, scene) == rows(((labels == 1) | (labels == 2)) & ~near)
    spec = f"labels:{tmp_path}/l.npy:1-sphere:0,0,0,1+labels:{tmp_path}/l.npy:2"
    assert members(spec, scene) == rows(((labels == 1) & ~near) | (labels == 2))
    assert members("all-sphere:0,0,0,1", scene) == rows(~near)


def test_intersection_keeps_both_and_steps_apply_to_all_before(scene: Gaussians) -> None:
    near = scene.means.norm(dim=1) <= 1.2
    right = scene.means[:, 0] >= 0
    spec = "sphere:0,0,0,1.2 & box:0,-99,-99,99,99,99"
    assert members(spec, scene) == rows(near & right)
    grown = members(f"{spec} | grow:2", scene)
    assert grown == members(f"{spec}|grow|grow", scene) > members(spec, scene)
    assert members(f"{spec}|grow:2-sphere:0,0,0,1.2", scene) == grown - rows(near)
    assert members(f"{spec}|refine", scene) == members(f"{spec}|refine:35", scene)
    assert members("all|largest", scene) <= members("all", scene)


def test_shapes_are_drawn_over_the_picture_of_a_camera(scene: Gaussians, tmp_path: Path) -> None:
    camera = orbit_camera(90, 60)
    save_cameras(tmp_path / "c.json", [orbit_camera(30, 30, azimuth=2.0), camera])
    points, _ = project_centers(scene, camera)
    seen = f"{tmp_path}/c.json:1"
    assert members(f"rectangle:{seen}:20,10,50,45.5", scene) == rows(
        inside_rectangle(points, (20, 10), (50, 45.5))
    )
    outline = [(10, 5), (80, 20), (40, 55)]
    assert members(f"lasso:{seen}:10,5,80,20,40,55", scene) == rows(inside_polygon(points, outline))
    assert members(f"brush:{seen}:12.5,10,5,80,20", scene) == rows(inside_stroke(points, outline[:2], 12.5))
    front = members(f"front:{seen}", scene)
    assert 0 < len(front) < COUNT
    assert members(f"lasso:{seen}:10,5,80,20,40,55&front:{seen}", scene) == front & rows(
        inside_polygon(points, outline)
    )


def test_color_and_flood_take_a_tolerance(scene: Gaussians) -> None:
    assert len(members("color:#808080,0.1", scene)) < len(members("color:#808080,.2", scene)) < COUNT
    assert members("color:#808080", scene) == members("color:#808080,0.08", scene)
    x, y, z = scene.means[7].tolist()
    assert 7 in members(f"flood:{x},{y},{z},0.3", scene)
    assert members(f"flood:{x},{y},{z},0.3", scene) <= members(f"flood:{x},{y},{z},1", scene)


def test_signs_in_numbers_and_file_names_join_nothing(scene: Gaussians, tmp_path: Path) -> None:
    path = tmp_path / "my-box+2" / "a-b+all.npy"
    path.parent.mkdir()
    labels = labels_file(path)
    assert members(f"labels:{path}:1-box:-9,-9,-9,0,+9,1e-9", scene) == rows(
        (labels == 1) & ~((scene.means[:, 0] <= 0) & (scene.means[:, 2] <= 1e-9)).numpy()
    )


SPECS = st.lists(
    st.tuples(
        st.sampled_from("+-"),
        st.one_of(
            st.just("all"),
            st.lists(st.floats(-1e9, 1e9), min_size=4, max_size=4).map(
                lambda xs: "sphere:" + ",".join(map(str, xs))
            ),
            st.from_regex(r"[a-z0-9+-]{1,12}", fullmatch=True)
            .filter(lambda s: "all" not in s)
            .map("labels:{}.npy:1".format),
        ),
    ),
    min_size=1,
    max_size=5,
)


@given(parts=SPECS, blank=st.sampled_from(["", " ", "  "]))
def test_joined_spec_is_split_again(parts: list[tuple[str, str]], blank: str) -> None:
    spec = parts[0][1] + "".join(f"{blank}{sign}{blank}{part}" for sign, part in parts[1:])
    assert split_spec(spec, KINDS) == [("+", parts[0][1]), *parts[1:]]


def test_caller_may_add_kinds(scene: Gaussians) -> None:
    def first(rest: str, scene: Gaussians) -> Region:
        return from_mask(rest, torch.arange(len(scene)) < int(rest))

    region = parse_region("all-first:150", scene, name="rest", kinds={"first": first})
    assert region.members.tolist() == list(range(150, COUNT))
    assert region.name == "rest"


# ---------------------------------------------------------------------------------------------- errors


def refusal(spec: str, scene: Gaussians) -> str:
    with pytest.raises(ProgdfError) as caught:
        parse_region(spec, scene)
    message = str(caught.value)
    assert len(message.splitlines()) == 1
    assert ";" in message
    return message


@pytest.mark.parametrize(
    ("spec", "said"),
    [
        ("", "is missing a part"),
        ("-all", "is missing a part"),
        ("all+", "unknown region"),
        ("everything", "unknown region"),
        ("cube:1,2,3", "all, labels:…, box:…, sphere:…"),
        ("box:1,2,3", "6 numbers"),
        ("box:1,2,3,4,5,six", "6 numbers"),
        ("sphere:0,0,0,nan", "4 numbers"),
        ("sphere:0,0,0,-1", "positive"),
        ("sphere:99,99,99,1", "the scene spans x"),
        ("all-all", "holds no Gaussian"),
        ("labels:nowhere.npy:1", "nowhere.npy does not exist"),
        ("labels:nowhere.npy", "has no label"),
        ("labels:nowhere.npy:one", "list of integers"),
        ("labels:nowhere.npy:1,", "list of integers"),
        ("lasso:1,2,3,4,5,6", "needs a camera"),
        ("lasso:nowhere.json:0:1,2,3,4,5,6", "nowhere.json does not exist"),
        ("front:", "needs a camera"),
        ("color:red", "write for example color:#903020"),
        ("color:#ff0000,2", "tolerance"),
        ("flood:1,2", "write flood:x,y,z"),
        ("all|grow:1000", "invalid region step"),
        ("sphere:0,0,0,1|grow:-3", "invalid region step 'grow:-3'"),
        ("all|largest:2", "invalid region step"),
        ("sphere:0,0,0,1|refine:101", "invalid region step 'refine:101'"),
        ("all|grow|GROW", "invalid region step 'grow|GROW'"),
        ("all|largest||", "invalid region step 'largest||'"),
        ("all|smooth+100", "invalid region step 'smooth+100'"),
        ("flood:1e308,-1e308,0", "numbers up to 1e+18"),
        ("box:0,0,0,1,1,1e19", "6 numbers up to 1e+18"),
    ],
)
def test_meaningless_spec_is_reported_in_one_line(spec: str, said: str, scene: Gaussians) -> None:
    assert said in refusal(spec, scene)


LONG = 1_000_000


@pytest.mark.parametrize(
    "spec",
    [
        f"all{' ' * LONG}",
        f"all{' ' * LONG}-sphere:0,0,0,1{' ' * LONG}",
        " " * LONG,
        "all" + "-" * LONG,
        "all" + "| " * (LONG // 2),
        "- " * (LONG // 2),
        "all" * (LONG // 3),
        "all-" * (LONG // 4) + "all",
        "all|grow" + "|grow" * (LONG // 5) + "|" + "grow:" * (LONG // 5),
        "sphere:" + "1," * (LONG // 2),
    ],
    ids=lambda spec: spec[:12],
)
def test_huge_spec_is_read_quickly_and_quoted_in_short(spec: str) -> None:
    """Parse a megabyte. Scanning the input once per character would take hours."""
    message = ""
    try:
        check_region(spec)
    except ProgdfError as refused:
        message = str(refused)
    assert len(message) < 500


# Tokens of the language, valid as often as not.
SCRAPS = st.sampled_from(
    [
        *(
            "all",
            "changed",
            "box:",
            "sphere:",
            "labels:",
            "file:",
            "color:",
            "flood:",
            "front:",
            "rectangle:",
        ),
        *(
            "lasso:",
            "brush:",
            "C:",
            "l.npy:",
            "m.npy",
            "#808080",
            "0,0,0,1",
            "-1,-1,-1,1,1,1",
            "0.1",
            "5,5,40,40",
        ),
        *(
            "5,5,40,40,60,10",
            "1e18",
            "-1e18",
            "1e308",
            "nan",
            "1e-320",
            "0",
            ":1",
            ",",
            "+",
            "-",
            "&",
            "|",
            " ",
        ),
        *(
            "|grow",
            "|shrink:2",
            "|smooth",
            "|largest",
            "|GROW",
            ":100",
            "\0",
            "\x1b[2J",
            "é",
            "\ud800",
            "~nobody",
        ),
    ]
)
WHOLE = st.sampled_from(
    [
        *("all", "box:-1,-1,-1,1,1,1", "sphere:0,0,0,1e18", "sphere:1e18,1e18,0,1", "labels:l.npy:1,2"),
        *("file:m.npy", "color:#808080,1", "flood:0,0,0,1", "flood:1e18,-1e18,0", "front:C"),
        *("rectangle:C:5,5,40,40", "lasso:C:5,5,40,40,60,10", "lasso:C:1e18,0,-1e18,1e-300,0,1e18"),
        *("brush:C:9,30,30", "brush:C:1e18,-1e18,1e18"),
    ]
)
SIGNS = st.sampled_from(["+", "-", " & ", "|grow+", "|smooth:2&", "|"])
STEPS = st.sampled_from(["|grow", "|shrink:2", "| smooth", "|largest", "|grow:100", "|refine:9"])
KIND = st.sampled_from(["box:", "sphere:", "flood:", "lasso:C:", "brush:C:", "rectangle:C:", "labels:l.npy:"])
NUMBERS = st.lists(
    st.sampled_from(
        ["0", "1", "-1", "0.1", "1e18", "-1e18", "1e308", "-1e308", "1e-320", "nan", "9" * 5000, ""]
    ),
    min_size=1,
    max_size=7,
).map(",".join)
SPECS_OF_ALL_KINDS = st.one_of(
    st.lists(st.one_of(WHOLE, SCRAPS), min_size=1, max_size=9).map("".join),
    st.lists(st.tuples(WHOLE, SIGNS).map("".join), max_size=5).map(lambda parts: "".join([*parts, "all"])),
    st.tuples(WHOLE, STEPS, SCRAPS, st.one_of(STEPS, SCRAPS)).map("".join),
    st.tuples(KIND, NUMBERS).map("".join),
)


@pytest.fixture(scope="module")
def folder_of_parts(scene: Gaussians, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("parts")
    labels_file(folder / "l.npy")
    np.save(folder / "m.npy", np.arange(0, COUNT, 3))
    save_cameras(folder / "C", [orbit_camera(90, 60)])
    return folder


@given(spec=SPECS_OF_ALL_KINDS)
def test_any_input_is_a_region_or_an_error(spec: str, scene: Gaussians, folder_of_parts: Path) -> None:
    notes: list[str] = []
    refused = []
    with contextlib.chdir(folder_of_parts):
        for read in (lambda: check_region(spec), lambda: parse_region(spec, scene, say=notes.append)):
            try:
                read()
            except ProgdfError as error:
                refused.append(str(error))
    assert all(len(line.splitlines()) == 1 for line in (*refused, *notes))
    assert len(refused) != 1 or "holds no Gaussian" in refused[0] or "no Gaussian with label" in refused[0]


def test_suspicious_parts_are_reported(scene: Gaussians) -> None:
    def said(spec: str) -> list[str]:
        lines: list[str] = []
        parse_region(spec, scene, say=lines.append)
        return lines

    x, y, z = scene.means[7].tolist()
    assert said("all-box:0,0,0,9,9,9|grow") == []
    assert said("color:#808080,0.1") == []
    assert said("color:#808080,1") == [
        "color:#808080,1 selects 100 % of the scene; lower its tolerance, or add &box:…"
    ]
    (note,) = said(f"flood:{x},{y},{z},1e-6")
    assert note.endswith("selects only 1 Gaussian; raise its tolerance, or name a point on a surface")
    assert said("all+box:99,99,99,100,100,100") == ["box:99,99,99,100,100,100 selects no Gaussian"]
    assert said("all - all + all") == ["the region is empty after -all"]
    assert said("sphere:0,0,0,0.5|shrink:9+all") == ["the region is empty after |shrink:9"]


def test_label_file_of_another_scene_or_kind_is_reported_in_one_line(
    scene: Gaussians, tmp_path: Path
) -> None:
    path = tmp_path / "l.npy"
    labels = labels_file(path)
    assert "no Gaussian with label 7; it has 0, 1, 2, 3, 4" in refusal(f"labels:{path}:7", scene)
    np.save(path, labels[:-1])
    assert "199 labels, the scene has 200 Gaussians" in refusal(f"labels:{path}:1", scene)
    np.save(path, labels.reshape(20, 10))
    assert "20x10 labels" in refusal(f"labels:{path}:1", scene)
    np.save(path, labels.astype(np.float32))
    assert "float32" in refusal(f"labels:{path}:1", scene)
    np.save(path, np.array([{}, []], dtype=object), allow_pickle=True)
    assert "not a readable .npy" in refusal(f"labels:{path}:1", scene)
    with path.open("wb") as file:
        np.savez(file, labels)
    assert "not a readable .npy" in refusal(f"labels:{path}:1", scene)
    np.save(path, labels)
    whole = path.read_bytes()
    bracket = whole.replace(b"{'descr': '", b"{'descr': (")
    leading_zero = whole.replace(b"|u1", b"|01")
    for content in (b"", b"hello", whole[:40], whole[:-1], bracket, leading_zero):
        path.write_bytes(content)
        refusal(f"labels:{path}:1", scene)
    assert "folder" in refusal(f"labels:{tmp_path}:1", scene)


def test_label_file_that_claims_too_much_allocates_nothing(scene: Gaussians, tmp_path: Path) -> None:
    path = tmp_path / "l.npy"
    labels_file(path)
    path.write_bytes(path.read_bytes().replace(b"(200,)", b"(9999999999,)").replace(b"       }", b"}", 1))
    assert "not a readable .npy" in refusal(f"labels:{path}:1", scene)


# -------------------------------------------------------------------------------------------- algebra

MASKS = st.lists(st.booleans(), min_size=12, max_size=12).map(torch.tensor)


@given(a=MASKS, b=MASKS)
def test_set_operations_match_those_of_sets(a: torch.Tensor, b: torch.Tensor) -> None:
    one = from_mask("a", a)
    two = from_mask("b", b)
    for operation, expected in ((union, a | b), (difference, a & ~b)):
        region = operation(one, two)
        assert region.members.tolist() == expected.nonzero()[:, 0].tolist()
        assert torch.equal(region.score, expected.float())


def test_soft_scores_are_kept() -> None:
    a = Region("a", torch.tensor([0, 1]), torch.tensor([0.9, 0.8, 0.4, 0.0]))
    b = Region("b", torch.tensor([1, 3]), torch.tensor([0.2, 0.75, 0.5, 1.0]))
    assert union(a, b).score.tolist() == pytest.approx([0.9, 0.8, 0.5, 1.0])
    assert difference(a, b).score.tolist() == pytest.approx([0.8, 0.25, 0.4, 0.0])
    assert difference(a, b).members.tolist() == [0]


def test_regions_of_different_scenes_do_not_mix() -> None:
    a, b = (from_mask(name, torch.ones(count, dtype=torch.bool)) for name, count in (("a", 3), ("b", 4)))
    for operation in (union, difference):
        with pytest.raises(ValueError, match="3 Gaussians, b of 4"):
            operation(a, b)


def test_real_labels_fit_their_scene(shared_data: Path) -> None:
    from progdf.formats.ply import load_ply

    real = load_ply(shared_data / "playbot_8k.ply")
    labels = f"labels:{shared_data / 'playbot_8k_labels.npy'}"
    robot = parse_region(f"all-{labels}:0", real)
    assert torch.equal(robot.members, parse_region(f"{labels}:1+{labels}:2+{labels}:3", real).members)
    assert 0 < len(robot) < len(real)
