"""OpenGL resources: programs, textures, buffers and passes."""
