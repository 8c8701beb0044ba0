"""What a slider, a frame and an idle window cost."""
