"""The edit optimisation that records a trajectory."""
