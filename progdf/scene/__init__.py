"""What is in a scene, and where?"""

from __future__ import annotations

from typing import Literal

Axis = Literal["+x", "-x", "+y", "-y", "+z", "-z"]
UpChoice = Literal["auto", "+x", "-x", "+y", "-y", "+z", "-z"]
"""An axis of a scene, and what an option says of which is up: without torch, for command lines."""
