"""The device engine: many runs of one structure as one program, with their environments in processes."""
