"""Scene analysis: bounds, neighbors, selections, regions, strays, subject, up axis and cameras."""

from __future__ import annotations

from typing import Literal

Axis = Literal["+x", "-x", "+y", "-y", "+z", "-z"]
"""Direction of a coordinate axis."""
UpChoice = Literal["auto", "+x", "-x", "+y", "-y", "+z", "-z"]
"""Values of an up axis option. Defined here so that command lines need not import torch."""
