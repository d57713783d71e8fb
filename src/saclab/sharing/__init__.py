"""A run's policy for others: what is told of it, what is left out, and the Hugging Face Hub."""
