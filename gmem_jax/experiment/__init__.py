"""One memory experiment: its description, its protocols, and what it recalls."""
