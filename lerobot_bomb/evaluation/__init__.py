"""Evaluation: from episode results to rates with intervals."""
