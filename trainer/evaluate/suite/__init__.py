"""The suite `sliders`: methods compared on edits whose pictures are known at every strength."""
