"""Side panel with layers, sliders, snapshots and jobs, and the bars over the picture."""
