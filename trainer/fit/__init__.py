"""Fitting of the shipped field to a recorded trajectory."""
