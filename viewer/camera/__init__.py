"""Viewing camera: geometry, controls and named views."""
