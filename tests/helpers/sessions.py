"""A session of the bear on disk, valid or with a spoiled value."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from progdf.compose import layer_paint
from progdf.compose.layers import Gains
from tests.helpers.ui_rig import bear, first_view
from viewer.app.messages import Messages
from viewer.app.parts.edits import EditActions
from viewer.app.parts.making import LayerMaker
from viewer.files import document, session
from viewer.files.document import DocumentStore
from viewer.files.session import WindowSession
from viewer.state import snapshots
from viewer.state.view_state import Comparison, Keyframe, LayerGroup, SnapshotPair, Timeline, ViewState
from viewer.state.workspace import Store


def full_view() -> ViewState:
    """Return a view in which every value differs from its default."""
    view = first_view(bear(), 0.25, 0.75)
    ears = bear().gdfs[1].region
    painted = layer_paint.encode(np.linspace(0, 1, len(ears)))
    layers = (
        replace(
            view.layers[1],
            name="ears → gold",
            gains=Gains(0.5, 0.25, 0.125),
            solo=True,
            paint=painted,
            group="warm",
            blend="sum",
        ),
        replace(view.layers[0], enabled=False),
    )
    camera = replace(view.camera, azimuth=33.5, mode="fly")
    film = Timeline((Keyframe(3, ((0, 0.5),), camera, "linear"),), length=30)
    compare = Comparison("split", 0.3, 8.0)
    view = replace(view, layers=layers, camera=camera, blend="over", compare=compare, timeline=film)
    groups = (LayerGroup("warm", strength=0.5),)
    pair = SnapshotPair("original", "1")
    return replace(view, groups=groups, collapsed=("warm",), cards="compact", pair=pair, unit=2.5)


def bear_files(folder: Path) -> Path:
    """Save the bear's scene into the folder and its edits into a subfolder. Return the folder."""
    (folder / "edits").mkdir()
    scene, *edits = bear().save(folder)
    for edit in edits:
        edit.rename(folder / "edits" / edit.name)
    assert scene.name == "bear.ply"
    return folder


def opened_document(folder: Path) -> document.Document:
    return document.load(folder / "bear.ply", [folder / "edits" / f"{g.name}.gdf" for g in bear().gdfs])


def saved_session(folder: Path) -> Path:
    """Save the session of `full_view` on the files of `bear_files`, with a snapshot. Return its path."""
    view = full_view()
    saved_snapshots = snapshots.take((), replace(view, blend="sum"))
    session.save(folder / "work.session.json", WindowSession(opened_document(folder), view, saved_snapshots))
    return folder / "work.session.json"


def spoilt(path: Path, *keys: str | int, value: Any = None) -> Path:
    """Write the session with another value at `keys` under another name. Return its path."""
    table = json.loads(path.read_text())
    place = table
    for key in keys[:-1]:
        place = place[key]
    place[keys[-1]] = value
    other = path.with_name("spoilt.session.json")
    other.write_text(json.dumps(table))
    return other


MAKING_S = 300.0
"""Time that tests wait for the layer of a manual edit, seconds."""


def layer_maker(store: Store, documents: DocumentStore, messages: Messages) -> LayerMaker:
    """Return a maker of layers that waits until they are ready."""
    edits = EditActions(store=store, documents=documents, messages=messages)
    return LayerMaker(
        store=store,
        documents=documents,
        messages=messages,
        edits=edits,
        wake=lambda: None,
        patience_s=MAKING_S,
    )
