"""Fixtures shared by several test files: real data if present, threads, golden screenshots."""

from __future__ import annotations

import gc
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

if "ATEN_CPU_CAPABILITY" in os.environ:
    # torch packs bfloat16 for the instructions that oneDNN detects. ATEN_CPU_CAPABILITY does not limit
    # oneDNN, and the packed format then fails
    os.environ.setdefault("ONEDNN_MAX_CPU_ISA", "AVX2")

import numpy as np
import pytest
import torch
from filelock import FileLock
from hypothesis import settings
from PIL import Image

from tests.helpers.browser import browser  # noqa: F401
from tests.helpers.goldens import SCREENSHOTS, difference
from tests.helpers.kernels import PARTS, run_kernels
from tests.helpers.paths import SHARED_DATA

if TYPE_CHECKING:
    import moderngl

pytest.register_assert_rewrite(
    "tests.helpers.ply_files", "tests.helpers.refused", "tests.helpers.stopped_runs"
)

# The same examples everywhere; the profile "search" draws new ones. A busy machine may
# take long for each example
settings.register_profile("same", derandomize=True, deadline=None)
settings.register_profile("search", derandomize=False, print_blob=True, deadline=None)
settings.load_profile("same")

Compare = Callable[[str, np.ndarray], None]


def pytest_configure() -> None:
    """Handle the stop signals that nohup, a script's `&` or a supervisor ignores.

    They stay without effect here. Children do not inherit that: an ignored signal stays ignored in a child, a
    handled one is reset to its default.
    """
    for name in ("SIGINT", "SIGHUP", "SIGTERM", "SIGQUIT"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) == signal.SIG_IGN:
            signal.signal(number, lambda *_: None)


def pytest_collection_finish() -> None:
    """Freeze the imported modules and collected tests, so that garbage collections skip them."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    """Use one torch thread. Several threads wait for each other on test-sized inputs."""
    torch.set_num_threads(1)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--regenerate-screenshots",
        action="store_true",
        help="write the golden screenshots instead of comparing",
    )


@pytest.fixture(scope="session", autouse=True)
def own_state_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep the user's remembered state (XDG_STATE_HOME) out of the tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture(scope="session", autouse=True)
def compiled_kernels(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Compile a part of the kernels in each xdist worker. All workers find every part in the cache."""
    worker = os.environ.get("PYTEST_XDIST_WORKER")
    if worker is None:
        return
    shared = tmp_path_factory.getbasetemp().parent
    count = len(PARTS)
    for part in range(count):
        mine = (part + int(worker.removeprefix("gw"))) % count
        ready = shared / f"kernels.{mine}.ready"
        with FileLock(ready.with_suffix(".lock")):
            if not ready.exists():
                run_kernels(PARTS[mine])
                ready.touch()


@pytest.fixture
def default_signals() -> Iterator[None]:
    """Handle SIGINT and SIGHUP as in a process started from a terminal."""
    defaults = {signal.SIGINT: signal.default_int_handler, signal.SIGHUP: signal.SIG_DFL}
    earlier = {number: signal.signal(number, handler) for number, handler in defaults.items()}
    yield
    for number, handler in earlier.items():
        signal.signal(number, handler)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Return the folder of real scenes and unusual files, or skip the test if it is absent.

    The folder is beside the checkout, or the one that PROGDF_TEST_DATA names.
    """
    folder = Path(os.environ.get("PROGDF_TEST_DATA", SHARED_DATA))
    if not folder.is_dir():
        pytest.skip(f"no real test data at {folder}")
    return folder


@pytest.fixture
def two_threads() -> Iterator[None]:
    """Rasterize with two threads, as on the smallest multicore machine."""
    from progdf.rasterize import set_threads

    set_threads(2)
    yield
    set_threads(None)


@pytest.fixture
def screenshot(request: pytest.FixtureRequest) -> Compare:
    """Return `screenshot(name, image)`, which compares an image with tests/screenshots/NAME.png.

    The image is float (0 to 1) or uint8. [H,W,3]
    """
    regenerate: bool = request.config.getoption("--regenerate-screenshots")

    def compare(name: str, image: np.ndarray) -> None:
        found = _uint8(image)
        golden = SCREENSHOTS / f"{name}.png"
        if regenerate:
            golden.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(found).save(golden, optimize=True)
            return
        if not golden.exists():
            pytest.fail(
                f"there is no golden {golden.name}; make it with --regenerate-screenshots, and look at it"
            )
        expected = np.asarray(Image.open(golden).convert("RGB"))
        if wrong := difference(expected, found):
            _write_difference(name, expected, found)
            pytest.fail(f"{name}: {wrong}; see screenshots/diff/{name}.png")

    return compare


def _uint8(image: np.ndarray) -> np.ndarray:
    if image.dtype == np.uint8:
        return image[..., :3]
    return np.round(np.clip(image[..., :3], 0.0, 1.0) * 255.0).astype(np.uint8)


def _write_difference(name: str, expected: np.ndarray, found: np.ndarray) -> None:
    """Save the golden, the found image and eight times their difference side by side."""
    panels = [expected, found]
    if expected.shape == found.shape:
        amplified = np.abs(expected.astype(int) - found.astype(int)) * 8
        panels.append(np.clip(amplified, 0, 255).astype(np.uint8))
    height = max(panel.shape[0] for panel in panels)
    padded = [np.pad(panel, ((0, height - panel.shape[0]), (0, 4), (0, 0))) for panel in panels]
    folder = SCREENSHOTS / "diff"
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate(padded, axis=1)).save(folder / f"{name}.png")


@pytest.fixture(scope="module")
def software_gpu() -> None:
    """Skip the test unless OpenGL is the software renderer of the goldens. Others differ in the last bits."""
    from progdf.errors import ProgdfError
    from viewer.render.gl_renderer import headless_context, is_software

    try:
        context = headless_context()
    except ProgdfError as error:
        pytest.skip(str(error))
    name = context.info["GL_RENDERER"]
    software = is_software(context)
    context.release()
    if not software:
        pytest.skip(f"goldens were drawn by llvmpipe, here is {name}")


@pytest.fixture(scope="module")
def ctx() -> Iterator[moderngl.Context]:
    """Yield an OpenGL context without a window."""
    from viewer.render.gl_renderer import headless_context

    context = headless_context()
    yield context
    context.release()
