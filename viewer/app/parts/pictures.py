"""Cameras and pictures from files: they move the view, become a decal, or go into the form of a new edit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import moderngl
import numpy as np

from progdf.camera import Camera
from progdf.compose.picture_layers import find_layer_files
from progdf.errors import ProgdfError
from progdf.io.cameras import camera_search_folder, load_cameras
from progdf.io.images import open_picture
from progdf.io.picture_camera import (
    PictureLayers,
    camera_file,
    layers_in_picture,
    save_picture_camera,
    stored_picture_camera,
)
from progdf.scene.match_views import view_thumbnail
from progdf.scene.taken_views import FoundView, TakenView, find_view, remember_view, taken_views
from viewer.app.inspect.frusta import viewpoints
from viewer.app.messages import Messages, Requests, WaitFor
from viewer.camera.view_camera import ViewCamera, from_camera, to_camera
from viewer.files import exports
from viewer.files.document import DocumentStore
from viewer.pictures.film import Pixels
from viewer.state.forms import with_picture
from viewer.state.transient import Decal, DecalGhost, Transient
from viewer.state.workspace import Dialog, Store, with_camera, with_transient
from viewer.ui.keys import shortcut

_MAX_TEXTURE_PX = 1024  # maximum longer side of a decal's picture on screen, pixels
_MIN_ALPHA = 0.05  # smallest alpha that counts as painted


def is_decal(path: Path) -> bool:
    """Return True if a picture has both transparent and visible pixels.

    Raises:
        ProgdfError: it cannot be read.
    """
    picture = open_picture(path)
    if not picture.has_transparency_data:
        return False
    low, high = picture.convert("RGBA").getchannel("A").getextrema()
    return bool(isinstance(low, int) and isinstance(high, int) and low < 255 and high > 0)


class DecalTextures:
    """GL textures of the pictures of decals.

    Args:
        context: the GL context of the textures
    """

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._textures: dict[int, moderngl.Texture] = {}  # by GL name

    def __len__(self) -> int:
        return len(self._textures)

    def load(self, path: Path) -> Decal:
        """Load a picture as a decal.

        Raises:
            ProgdfError: it cannot be read.
        """
        picture = open_picture(path).convert("RGBA")
        picture.thumbnail((_MAX_TEXTURE_PX, _MAX_TEXTURE_PX))
        pixels = np.asarray(picture)
        texture = self._context.texture(picture.size, 4, pixels.tobytes(), alignment=1)
        texture.build_mipmaps()
        texture.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
        self._textures[int(texture.glo)] = texture
        return Decal(path, int(texture.glo), picture.size, pixels[..., 3] > 255 * _MIN_ALPHA)

    def keep(self, transient: Transient) -> None:
        """Free the textures of decals that are neither being placed nor in training."""
        used = {ghost.texture for ghost in transient.ghosts if isinstance(ghost, DecalGhost)}
        if isinstance(transient.gizmo, Decal):
            used.add(transient.gizmo.texture)
        for name in self._textures.keys() - used:
            self._textures.pop(name).release()


class PictureActions:
    """Cameras and pictures that are opened, and cameras that are saved.

    Args:
        store: state of the window
        documents: the open document
        messages: messages to the user
        context: the GL context of decals
        picture_size: returns width and height of the picture on screen, in pixels
        original: returns the picture on screen without edits, at its full size
        wait_for: runs work in another thread while the window shows a text
    """

    def __init__(
        self,
        *,
        store: Store,
        documents: DocumentStore,
        messages: Messages,
        context: moderngl.Context,
        picture_size: Callable[[], tuple[int, int]],
        original: Callable[[], Pixels],
        wait_for: WaitFor,
    ) -> None:
        self._store = store
        self._documents = documents
        self._messages = messages
        self.decals = DecalTextures(context)
        """Textures of decals."""
        self._picture_size = picture_size
        self._original = original
        self._wait_for = wait_for
        # picture, nearest view, view before
        self._asked: tuple[Path, FoundView, ViewCamera] | None = None

    @property
    def requests(self) -> Requests:
        """Handlers of the answers to "Is it this view?", by name. `use_view` names the picture."""
        return {
            "use_view": lambda _: self._use_view(),
            "keep_view": lambda _: self._keep_view(),
            "cameras": lambda _: self._toggle_cameras(),
        }

    def poll(self) -> None:
        """Free the textures of decals that are no longer on screen."""
        self.decals.keep(self._store.get().transient)

    def remember(
        self, image: Pixels, camera: Camera, edits: Sequence[str], layers: PictureLayers | None
    ) -> None:
        """Remember a view that was taken of the open scene, to find pictures that lost their camera."""
        document = self._documents.get()
        if document.path is not None:
            remember_view(document.path, image, camera, edits, document.scene.origin, layers)

    def look_through(self, path: Path) -> None:
        """Move the view to the first camera of a file, and show all of them in the picture.

        Raises:
            ProgdfError: the file holds no camera.
        """
        cameras = load_cameras(path, self._documents.get().scene.origin)
        self._take_camera(cameras[0])
        if len(cameras) > 1:
            self._show_cameras(cameras, path if path.is_dir() else path.parent)
        self._messages.show(f"View set to the first camera of {path.name}")

    def _toggle_cameras(self) -> None:
        """Hide the cameras in the picture, or show those beside the scene.

        Raises:
            ProgdfError: there are none, or several sources of them.
        """
        work = self._store.get()
        path = self._documents.get().path
        if work.transient.viewpoints:
            self._store.replace(with_transient(work, viewpoints=()))
            return
        if path is None:
            raise ProgdfError("this scene has no folder; drop the file of its cameras on the window")
        folder = camera_search_folder(path)
        beside = path.with_name(f"{path.stem}{exports.CAMERAS}")
        source = beside if beside.is_file() else folder
        self._show_cameras(load_cameras(source, self._documents.get().scene.origin), folder)

    def _show_cameras(self, cameras: Sequence[Camera], folder: Path) -> None:
        work = self._store.get()
        shown = viewpoints(cameras, folder, work.view.camera, self._documents.get().bounds)
        self._store.replace(with_transient(work, viewpoints=shown))
        self._store.wake()

    def open(self, path: Path) -> None:
        """Place a picture with transparency as a decal; edit the scene by any other picture.

        Raises:
            ProgdfError: see `edit_picture`.
        """
        if is_decal(path) and self._documents.get().path is not None:
            decal = self.decals.load(path)
            self._store.replace(with_transient(self._store.get(), gizmo=decal))
            self._store.wake()
        else:
            self.edit_picture(path)

    def edit_picture(self, path: Path) -> None:
        """Put an edited picture into the form of a new edit, and move the view to its camera.

        Raises:
            ProgdfError: it is not a picture, its camera is invalid, or it shows edits whose files are
                missing.
        """
        camera = stored_picture_camera(path, origin=self._documents.get().scene.origin)
        if camera is None:
            self._search_view(path)
            return
        layers = layers_in_picture(path)
        if layers is not None:
            find_layer_files(layers, path, self._documents.get().path)
        self._fill_form(path, camera)

    def _fill_form(self, path: Path, camera: Camera) -> None:
        self._take_camera(camera)
        work = self._store.get()
        form = with_picture(work.form, path, work.form_open)
        self._store.replace(replace(work, form=form, form_open=True))

    def _search_view(self, path: Path) -> None:
        """Find the view that a picture without a camera shows, among the taken ones and the current view.

        If none is certain, move the view to the nearest one and ask.

        Raises:
            ProgdfError: it is not a picture, its camera cannot be written, or it shows edits whose files are
                unknown.
        """
        document = self._documents.get()
        origin = document.scene.origin
        before = self._store.get().view.camera
        original = self._original()
        camera = to_camera(before, original.shape[1], original.shape[0])
        current = TakenView(view_thumbnail(original), camera)

        def search() -> FoundView | None:
            taken = [] if document.path is None else taken_views(document.path, origin)
            return find_view(path, [current, *taken])

        found = self._wait_for(search, f"Searching the view of {path.name} …")
        if found is None:
            raise ProgdfError(f"{path.name} carries no camera; take a view with {shortcut('take_view')}")
        if found.match.certain:
            save_picture_camera(path, found.camera, origin, found.view.checked_layers(path.name))
            self._fill_form(path, found.camera)
            self._messages.show(f"Found the view of {path.name}: {found.agreement}")
            return
        self._asked = (path, found, before)
        self._take_camera(found.camera)
        self._messages.ask(Dialog("match", str(path)))

    def _use_view(self) -> None:
        """Take the nearest view as that of the picture.

        Raises:
            ProgdfError: its camera cannot be written beside the picture, or it shows edits whose files are
                unknown.
        """
        if self._asked is not None:
            path, found, _ = self._asked
            self._asked = None
            layers = found.view.checked_layers(path.name)
            save_picture_camera(path, found.camera, self._documents.get().scene.origin, layers)
            self._fill_form(path, found.camera)

    def _keep_view(self) -> None:
        """Return to the view before the question, and tell how a picture gets its camera."""
        if self._asked is not None:
            path, _, before = self._asked
            self._asked = None
            self._store.replace(with_camera(self._store.get(), before))
            self._messages.show(
                f"{path.name} has no view. Turn the scene to its view and drop it again, "
                f"or put {camera_file(path).name} beside it."
            )

    def keep_camera(self, session: Path | None) -> None:
        """Add the view on screen to the cameras stored next to the session, or next to the scene.

        Raises:
            ProgdfError: see `exports.camera`.
        """
        document = self._documents.get()
        beside = session or document.path or exports.folder_of(None) / document.title
        camera = to_camera(self._store.get().view.camera, *self._picture_size())
        path, count = exports.camera(beside, camera, document.scene.origin)
        self._messages.show(f"Saved as camera {count} in {path.resolve()}")

    def _take_camera(self, camera: Camera) -> None:
        work = self._store.get()
        view_camera = from_camera(work.view.camera, camera, self._documents.get().bounds)
        self._store.replace(with_camera(work, view_camera))
