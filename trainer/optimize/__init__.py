"""Edit optimization that records a trajectory."""
