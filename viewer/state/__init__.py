"""State of the window as immutable data and pure functions, without GL or imgui."""
