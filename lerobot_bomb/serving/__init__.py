"""Serving: what LeRobot's policy server may receive."""
