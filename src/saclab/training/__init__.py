"""A run: the loop, its tests of the policy, and what it leaves on disk."""
