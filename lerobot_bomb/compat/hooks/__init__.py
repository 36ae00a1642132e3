"""Hooks into LeRobot and what it stands on; docs/architecture.md lists them, with the reason of each."""
