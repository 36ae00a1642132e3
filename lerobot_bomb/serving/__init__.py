"""What LeRobot's policy server may receive."""
