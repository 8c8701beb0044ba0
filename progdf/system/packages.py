"""Packages of other projects: how to install an extra, and which package cannot be imported."""

from __future__ import annotations

import sys

DISTRIBUTION = "progdf-studio"

_OWN = {"progdf", "trainer", "viewer", "shaders", "benchmarks", "release", "tests", "__main__"}


def is_bundle() -> bool:
    """Return True in the desktop bundle, which holds no extras and has no pip."""
    return bool(getattr(sys, "frozen", False))


def install_extra(extra: str) -> str:
    """Return how to install an extra, as the remedy of a message.

    Args:
        extra: name of the extra in pyproject.toml
    """
    return pip_install(f"'{DISTRIBUTION}[{extra}]'", f'"{DISTRIBUTION}[{extra}]"')


def pip_install(arguments: str, package: str = DISTRIBUTION) -> str:
    """Return how to install a package, as the remedy of a message.

    Args:
        arguments: arguments of pip
        package: this package as an argument of pipx, for the desktop bundle, which has no pip
    """
    if is_bundle():
        return f"the desktop bundle does not hold it: install the Python package by pipx install {package}"
    return f"pip install {arguments}"


def install_again() -> str:
    """Return how to repair a required package, as the remedy of a message."""
    return "unpack the desktop bundle again" if is_bundle() else f"install {DISTRIBUTION} with pip again"


def broken_package(error: BaseException) -> str:
    """Return the package of another project whose import raised an error; "" if the error has another cause.

    Of packages that import each other it is the innermost. The error may be of any type, as a package that
    finds a library broken raises an OSError or a RuntimeError too.
    """
    package = ""
    trace = error.__traceback__
    while trace is not None:
        frame = trace.tb_frame
        root = str(frame.f_globals.get("__name__", "")).partition(".")[0]
        if frame.f_code.co_name == "<module>" and root not in _OWN:
            package = root
        trace = trace.tb_next
    if not package and isinstance(error, ImportError) and error.name:
        root = error.name.partition(".")[0]
        package = "" if root in _OWN else root
    return package


def import_fault(error: BaseException) -> str:
    """Return the reason why a package cannot be imported, in at most 300 characters."""
    message = " ".join(str(error).split())
    return f"{type(error).__name__}: {message}"[:300] if message else type(error).__name__
