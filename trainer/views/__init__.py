"""The views an edit is trained on."""
