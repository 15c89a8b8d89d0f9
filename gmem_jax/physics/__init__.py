"""What one time step is, in plain JAX: the definition that everything faster is checked against. It knows no
experiment.
"""
