"""The SAC family in pure JAX: no environment, no file, no clock, no hidden state."""
