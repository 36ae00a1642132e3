"""Explanations of a policy's actions."""
