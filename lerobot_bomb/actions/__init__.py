"""Continuous actions as bins, and bins as integer text."""
