"""Tests with a Hub on this machine."""
