"""Results of episodes: typed records, read and written; which of them compare, and what they say together."""
