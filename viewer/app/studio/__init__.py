"""New edits and deliveries in the window: what its requests start, and what comes back."""
