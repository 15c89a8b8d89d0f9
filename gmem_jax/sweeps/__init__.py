"""Sweeps: many experiments planned as few runs, done by several processes, with one store of results."""
