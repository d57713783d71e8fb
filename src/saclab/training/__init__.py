"""A run: its state, the engine that steps it, the loop, its evaluations, and what it leaves on disk."""
