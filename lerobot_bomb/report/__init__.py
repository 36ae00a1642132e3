"""What files of results say, as a page for people and as tables for programs."""
