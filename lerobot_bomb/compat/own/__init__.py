"""What our own commands change, in their own process."""
