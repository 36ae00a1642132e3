"""Reports on files of results: a page for people, and tables for programs."""
