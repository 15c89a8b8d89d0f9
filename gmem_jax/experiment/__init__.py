"""One memory experiment: its description, its walls, the one loop that walks through it, and what it recalls."""
