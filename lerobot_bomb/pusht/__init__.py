"""What the env type `bomb_pusht` is: its axes, its episodes, why they fail; numpy only, no simulator."""
