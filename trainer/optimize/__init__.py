"""The edit optimization that records a trajectory."""
