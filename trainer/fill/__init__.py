"""Filling of the holes that a removed region leaves: smooth patches, or texture that continues."""
