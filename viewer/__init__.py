"""Interactive viewer and its headless counterpart."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .widget import Widget

__all__ = ["Widget"]


def __getattr__(name: str) -> Any:
    """Import `Widget` on first use, as it needs the extra `jupyter`."""
    if name != "Widget":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from .widget import Widget

    return Widget
