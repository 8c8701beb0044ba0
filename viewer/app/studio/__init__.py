"""New edits, previews, deliveries and the start page of the window."""
