"""One time step in plain JAX: the definition of the physics, against which all faster code is checked."""
