"""From episode results to rates with intervals."""
