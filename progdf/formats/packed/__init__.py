"""Scenes in quantized formats: compressed .ply, .splat, .ksplat and SOG."""
