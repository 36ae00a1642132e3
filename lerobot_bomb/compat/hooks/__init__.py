"""Hooks into LeRobot and its libraries; docs/architecture.md lists them, with the reason for each."""
