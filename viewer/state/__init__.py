"""What the window shows, as pure data and functions: no GL, no imgui."""
