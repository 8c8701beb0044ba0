"""Ablation: the method without each of its parts."""
