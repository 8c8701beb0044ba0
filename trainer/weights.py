"""What goes wrong when a pretrained network is read from this machine."""

from __future__ import annotations

from safetensors import SafetensorError

BROKEN = (OSError, ValueError, RuntimeError, KeyError, TypeError, SafetensorError)
"""What transformers and diffusers raise for a model that is not there, not whole, or another's."""
