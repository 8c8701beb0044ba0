"""Export of a scene under its edits as one web page with sliders."""
