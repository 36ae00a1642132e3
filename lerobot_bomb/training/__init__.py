"""Training: flags, several processes, randomness."""
