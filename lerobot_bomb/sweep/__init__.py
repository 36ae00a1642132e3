"""Sweep of many evaluations, which can be killed, split and resumed."""
