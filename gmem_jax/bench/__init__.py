"""Measurements of the cost of a grain-step, here and in LAMMPS."""
