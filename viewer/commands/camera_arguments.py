"""Where `progdf render` looks from: a camera of a file, that of a session, or one that frames something."""

from __future__ import annotations

from collections.abc import Sequence

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf
from progdf.io.cameras import read_camera
from viewer.camera.up_axis import Vec3
from viewer.camera.view_camera import ViewCamera, bounds_of, first_camera, fit, fit_subject, frame, to_camera

from . import arguments
from .options import RenderOptions

DEFAULT_SIZE = (640, 480)


def choose_camera(
    options: RenderOptions,
    scene: Gaussians,
    gdfs: Sequence[Gdf],
    size: tuple[int, int] | None,
    saved: ViewCamera | None,
    up: Vec3 | None = None,
) -> Camera:
    """The camera that was asked for; that of the session (`saved`); or one that frames the scene.

    Args:
        options: camera, orbit and frame of it
        scene: the original
        gdfs: its edits, which --frame may name
        size: (width, height) in pixels; None: the camera's own, or `DEFAULT_SIZE`
        saved: of a session
        up: unit vector that is up in the scene; None finds it

    Raises:
        ProgdfError: options that contradict each other or name nothing.
    """
    if options.camera is not None and options.orbit is not None:
        raise ProgdfError("--camera and --orbit cannot be combined; give only one of them")
    if options.camera is not None:
        if options.frame is not None:
            raise ProgdfError("--camera and --frame cannot be combined; give only one of them")
        camera = read_camera(options.camera)
        return camera if size is None else arguments.fit_camera(camera, size)
    width, height = size or DEFAULT_SIZE
    aspect = width / height
    view = saved or first_camera(scene, aspect=aspect, up=up)
    if options.orbit is not None:
        view = arguments.parse_orbit(options.orbit, view)
    if options.frame is not None or (options.orbit is not None and saved is None):
        view = _frame_on(view, options.frame, scene, gdfs, aspect)
        if options.orbit is not None:  # a distance that was said holds
            view = arguments.parse_orbit(options.orbit, view)
    return to_camera(view, width, height)


def _frame_on(
    view: ViewCamera, name: str | None, scene: Gaussians, gdfs: Sequence[Gdf], aspect: float
) -> ViewCamera:
    """The same direction, filled by what --frame names."""
    if name is None:
        return fit_subject(view, scene, aspect)
    if name == "all" and name not in [gdf.name for gdf in gdfs]:
        return frame(view, bounds_of(scene), aspect)
    known = arguments.known_edit(name, gdfs, "--frame")
    (members,) = (gdf.region.members for gdf in gdfs if gdf.name == known)
    return fit(view, scene[members], aspect)
