"""GLSL sources, one file a stage; see viewer.gl.programs for how they are read."""
