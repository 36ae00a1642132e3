"""Parts that all our environments share; quick to import, for simulator processes."""
