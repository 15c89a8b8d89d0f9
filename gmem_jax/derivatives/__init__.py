"""Derivatives of a whole experiment, in forward and in reverse mode."""
