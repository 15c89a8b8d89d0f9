"""What a grain-step costs, here and in LAMMPS beside it."""
