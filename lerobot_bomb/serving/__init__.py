"""Serving: checks of the messages to LeRobot's policy server."""
