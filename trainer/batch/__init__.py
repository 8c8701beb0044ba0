"""Many runs at once: a catalogue of jobs, on one machine or on a Ray cluster."""
