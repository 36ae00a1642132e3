"""Explanations: why a policy does what it does."""
