"""GLSL sources: includes, errors with file and line, and layouts that match their dtypes."""

from __future__ import annotations

import re
from importlib import resources

import moderngl
import numpy as np
import pytest

import shaders
from progdf.gaussians import ATTRIBUTES
from progdf.rasterize import engines
from shaders import ShaderError, load_source
from viewer.gl.programs import load_program
from viewer.gl.scene_textures import GRID_LINE, ORDER, PROJECTED, SPLAT_TEXTURES, TEXTURE_SLOTS
from viewer.gl.splats import vertex_format
from viewer.render.ground_grid import CLEAR

STAGES = (
    "project.vert",
    "splat.vert",
    "splat.frag",
    "web.vert",
    "present.vert",
    "present.frag",
    "stretch.frag",
)
COMPONENTS = {"float": 1, "vec2": 2, "vec3": 3, "vec4": 4}


def text_of(name: str) -> str:
    return (resources.files("shaders") / name).read_text(encoding="utf-8")


def declared(name: str, qualifier: str) -> list[tuple[str, int]]:
    """Return names and component counts of a stage's inputs or outputs, in order."""
    pattern = re.compile(rf"^{qualifier} (\w+) (\w+);", re.MULTILINE)
    return [(found[2], COMPONENTS[found[1]]) for found in pattern.finditer(text_of(name))]


def fields(dtype: np.dtype) -> list[tuple[str, int]]:
    return [(name, int(np.prod(dtype[name].shape, dtype=int))) for name in dtype.names or ()]


def test_projected_layout_matches_both_shader_stages() -> None:
    assert declared("project.vert", "out") == fields(PROJECTED)
    assert declared("splat.vert", "in") == fields(PROJECTED)
    assert vertex_format(PROJECTED) == "2f 3f 1f 4f"
    assert PROJECTED.itemsize == 40, "tightly packed, as transform feedback writes it"


def test_grid_line_layout_matches_its_dtype() -> None:
    assert declared("grid.vert", "in") == fields(GRID_LINE)
    assert f"const float CLEAR = {CLEAR};" in text_of("grid.frag")


def test_order_is_one_unsigned_integer_per_gaussian() -> None:
    assert re.search(r"^in uint splat;", text_of("project.vert"), re.MULTILINE)
    assert np.dtype("<u4") == ORDER


def test_scene_textures_declare_the_fields_of_their_dtypes_in_order() -> None:
    source = text_of("include/raw_splats.glsl")
    samplers = dict(re.findall(r"^uniform sampler2D (\w+);\s*//\s*(.*)$", source, re.MULTILINE))
    assert set(samplers) == {*SPLAT_TEXTURES, "shN"}
    for name, dtype in SPLAT_TEXTURES.items():
        assert dtype.itemsize == 16, "one rgba32f texel"
        places = [samplers[name].index(field) for field in dtype.names or ()]
        assert places == sorted(places), f"{name}: {samplers[name]}"


def test_shader_constants_equal_the_rasterizer_constants() -> None:
    found = dict(re.findall(r"const float (\w+) = ([^;]+);", text_of("include/conventions.glsl")))
    assert len(found) == 5
    for name, value in found.items():
        numerator, _, denominator = value.partition("/")
        assert float(numerator) / float(denominator or 1) == getattr(engines, name), name


def test_every_attribute_has_its_own_texture_components() -> None:
    assert set(TEXTURE_SLOTS) == set(ATTRIBUTES)
    taken = [
        (place.texture, place.component + i)
        for place in TEXTURE_SLOTS.values()
        for i in range(place.components)
    ]
    assert len(set(taken)) == len(taken)
    assert {texture for texture, _ in taken} == {*SPLAT_TEXTURES, "shN"}


def test_shader_heads_document_inputs_and_outputs() -> None:
    for name in STAGES:
        head = text_of(name).split("void main")[0]
        assert "// Reads " in head, name
        assert "// Writes " in head, name


def test_include_is_inserted_once_and_keeps_line_numbers() -> None:
    source = load_source("project.vert")
    assert source.files[0] == "project.vert"
    assert len(set(source.files)) == len(source.files) == 6
    assert source.text.count("const float DILATION") == 1
    lines = source.text.splitlines()
    after = next(i for i, line in enumerate(lines) if line.startswith("in uint splat"))
    number = next(
        i for i, line in enumerate(text_of("project.vert").splitlines(), 1) if "in uint splat" in line
    )
    directive = max(i for i in range(after) if lines[i].startswith("#line"))
    assert lines[directive].split()[2] == "0"
    assert int(lines[directive].split()[1]) + after - directive - 1 == number


def test_missing_include_error_names_the_including_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("shaders")
    (folder / "a.vert").write_text('#version 330 core\n\n#include "include/nope.glsl"\n')
    monkeypatch.setattr(shaders.resources, "files", lambda _: folder)
    with pytest.raises(ShaderError, match=r"shaders/include/nope\.glsl does not exist; shaders/a\.vert:3"):
        load_source("a.vert")


@pytest.mark.gl
def test_error_in_an_include_names_its_file_and_line(
    ctx: moderngl.Context, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("shaders")
    (folder / "broken.glsl").write_text("const float FINE = 1.0;\n\nfloat f() { return undeclared; }\n")
    (folder / "a.vert").write_text(
        '#version 330 core\n#include "broken.glsl"\nvoid main() { gl_Position = vec4(f()); }\n'
    )
    monkeypatch.setattr(shaders.resources, "files", lambda _: folder)
    with pytest.raises(ShaderError, match=r"shaders/broken\.glsl:3: error"):
        load_program(ctx, "a.vert", varyings=("gl_Position",))


@pytest.mark.gl
def test_error_after_an_include_names_the_line_of_the_stage(
    ctx: moderngl.Context, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("shaders")
    (folder / "fine.glsl").write_text("const float FINE = 1.0;\n")
    (folder / "a.vert").write_text("#version 330 core\nvoid main() { gl_Position = vec4(1.0); }\n")
    (folder / "a.frag").write_text(
        '#version 330 core\nout vec4 color;\n#include "fine.glsl"\nvoid main() { color = nothing; }\n'
    )
    monkeypatch.setattr(shaders.resources, "files", lambda _: folder)
    with pytest.raises(ShaderError, match=r"shaders/a\.frag:4: .*nothing"):
        load_program(ctx, "a.vert", "a.frag")


@pytest.mark.gl
def test_every_program_compiles_as_gl_3_3_core(ctx: moderngl.Context) -> None:
    load_program(ctx, "project.vert", varyings=PROJECTED.names or ()).release()
    load_program(ctx, "splat.vert", "splat.frag").release()
    load_program(ctx, "web.vert", "splat.frag").release()
    load_program(ctx, "present.vert", "present.frag").release()
    load_program(ctx, "present.vert", "stretch.frag").release()
