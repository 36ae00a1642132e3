"""What every environment of ours shares; light, as simulator processes import it."""
