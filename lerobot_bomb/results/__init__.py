"""Results of episodes: typed records, read, written, grouped and summarised."""
