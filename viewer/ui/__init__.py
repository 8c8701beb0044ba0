"""Window, keys, imgui context and widgets shared by all panels."""
