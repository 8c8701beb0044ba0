"""From state to pixels."""
