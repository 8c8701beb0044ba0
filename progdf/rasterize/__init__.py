"""The differentiable rasteriser: one signature, three engines."""
