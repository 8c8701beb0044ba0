"""What carries the sliders out of the house: a scene under its edits as one web page."""
