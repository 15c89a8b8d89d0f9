"""Contact mechanics of spheres and walls: kinematics, the normal force, friction laws."""
