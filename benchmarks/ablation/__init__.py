"""The method without each of its parts."""
