"""Readers and writers of scenes in all supported file formats."""
