"""Contact mechanics: kinematics once, then the normal law, then a friction law; walls alike."""
