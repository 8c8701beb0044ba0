"""The panel: layers, sliders, snapshots, timeline."""
