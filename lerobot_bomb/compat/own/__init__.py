"""Changes that our own commands make, in their own process."""
