"""What the env type `bomb_libero` is: its axes, its episodes, why they fail; numpy only, no simulator."""
