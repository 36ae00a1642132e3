"""What trainings share: flags, several processes, randomness."""
