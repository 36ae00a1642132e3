"""Greedy decoding under a token grammar."""
