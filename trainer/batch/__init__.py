"""Batches of runs: a catalogue of jobs on one machine or on a Ray cluster."""
