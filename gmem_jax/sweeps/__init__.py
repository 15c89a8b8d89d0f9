"""Sweeps: many experiments planned as few runs, their results in one store, done by any number of processes."""
