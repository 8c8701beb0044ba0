"""Readers and writers of quantized scene formats: compressed .ply, .splat, .ksplat and SOG."""
