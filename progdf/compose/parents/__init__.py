"""Layers that carry others: a move takes the changes of other layers, and the rows that they add, along."""
