"""Parts that all our environments share; light, as simulator processes import it."""
