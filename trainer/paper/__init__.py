"""ProGDF (AAAI 2025) as printed, with the readings of its open points that work (docs/paper.md)."""
