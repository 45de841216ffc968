"""The games of the chapter on the algorithm: two numbers, scalar control, players of the keys."""
