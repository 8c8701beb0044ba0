"""From a recorded trajectory to the field that is shipped."""
