"""Checkpoints and recorded datasets on the Hub: cards and pushing."""
