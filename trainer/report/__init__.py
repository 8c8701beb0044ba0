"""What a run reached, measured and shown."""
