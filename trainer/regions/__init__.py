"""Regions that pictures tell of."""
